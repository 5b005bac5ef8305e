// Starts all parts; for print, details open (but no long lists) and charts take the width of a page.

startControls();
const fitCharts = startCharts();
startFilm();
startVehicle();
clock.set(clock.now);
clock.show(clock.from, clock.to);

const SHEET = 690, opened = [];
window.addEventListener("beforeprint", () => {
  for (const part of document.querySelectorAll("details:not([open]):not(.listed)")) {
    part.open = true;
    opened.push(part);
  }
  for (const { u, host } of charts) u.setSize({ width: host.closest(".pair") ? SHEET / 2 - 16 : SHEET, height: u.height });
});
window.addEventListener("afterprint", () => {
  for (const part of opened.splice(0)) part.open = false;
  fitCharts();
});
document.documentElement.dataset.ready = "yes";
