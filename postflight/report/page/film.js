// The film strip: choosing a frame sets the time; beside the charts stands the frame nearest to the cursor.

function startFilm() {
  const buttons = [...document.querySelectorAll(".frame")];
  if (!buttons.length) return;
  const large = document.getElementById("nearest"), words = document.getElementById("nearest-words");
  const times = data.frames.map((frame) => frame.t);
  for (const button of buttons) button.addEventListener("click", () => clock.set(+button.dataset.time));
  clock.onCursor.push((t) => {
    const k = nearestRow(times, t), frame = data.frames[k];
    buttons.forEach((button, i) => button.setAttribute("aria-current", i === k));
    const picture = buttons[k].querySelector("img");
    if (large.dataset.time === String(frame.t)) return;
    large.dataset.time = frame.t;
    large.src = picture.src;
    large.alt = picture.alt;
    words.textContent = `Nearest frame: ${frame.t.toFixed(2)} s` +
      (frame.theta === null ? ", not used" : `, ${frame.theta.toFixed(2)}° ± ${frame.sd.toFixed(2)} by video`);
  });
}
