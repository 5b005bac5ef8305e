"use strict";
// The page's one time: the cursor and the window, and the functions to call when they change.

const data = JSON.parse(document.getElementById("data").textContent);
// twice a screen's pixels at least, so that charts print sharp
window.devicePixelRatio = Math.max(2, window.devicePixelRatio || 1);

const clock = {
  now: data.peak,
  from: data.first[0],
  to: data.first[1],
  onCursor: [],
  onWindow: [],

  set(t) {
    if (!Number.isFinite(t)) return;
    clock.now = Math.min(Math.max(t, data.span[0]), data.span[1]);
    for (const call of clock.onCursor) call(clock.now);
  },

  show(from, to) {
    const least = 0.05;
    from = Math.max(from, data.span[0]);
    to = Math.min(to, data.span[1]);
    if (to - from < least) return;
    clock.from = from;
    clock.to = to;
    for (const call of clock.onWindow) call(from, to);
  },

  // zoom about the cursor, or about the middle where the cursor is out of sight
  zoom(factor) {
    const inside = clock.now >= clock.from && clock.now <= clock.to;
    const about = inside ? clock.now : 0.5 * (clock.from + clock.to);
    clock.show(about - (about - clock.from) * factor, about + (clock.to - about) * factor);
  },

  pulse() { clock.show(data.pulse[0], data.pulse[1]); },
  whole() { clock.show(data.span[0], data.span[1]); },

  // move the cursor by a share of the window, and the window with it
  step(share) {
    const width = clock.to - clock.from;
    clock.set(clock.now + share * width);
    if (clock.now < clock.from) clock.show(clock.now, clock.now + width);
    if (clock.now > clock.to) clock.show(clock.now - width, clock.now);
  },

  key(event) {
    const far = event.shiftKey ? 0.05 : 0.005;
    const does = {
      ArrowLeft: () => clock.step(-far), ArrowRight: () => clock.step(far),
      "+": () => clock.zoom(0.6), "=": () => clock.zoom(0.6), "-": () => clock.zoom(1 / 0.6),
      0: clock.whole, Home: clock.whole, p: clock.pulse, P: clock.pulse,
    }[event.key];
    if (!does || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    does();
  },
};

function utcWords(t, digits) {
  const unit = 1000 / 10 ** (digits || 0);
  return new Date(Math.round((data.t0_ms + t * 1000) / unit) * unit).toISOString().slice(11, digits ? 20 + digits : 19);
}

// row at or before t of ascending times
function rowBefore(times, t) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t) low = middle; else high = middle - 1;
  }
  return low;
}

function nearestRow(times, t) {
  const k = rowBefore(times, t);
  return k + 1 < times.length && times[k + 1] - t < t - times[k] ? k + 1 : k;
}

// on the straight line between two neighbours; null outside them and in gaps
function between(times, values, t) {
  if (t < times[0] || t > times[times.length - 1]) return null;
  const k = rowBefore(times, t), n = Math.min(k + 1, times.length - 1), step = times[n] - times[k];
  if (t === times[k] || step <= 0) return values[k];
  if (values[k] === null || values[n] === null) return null;
  return values[k] + (t - times[k]) / step * (values[n] - values[k]);
}

function startControls() {
  const slider = document.getElementById("time"), words = document.getElementById("now");
  [slider.min, slider.max] = data.span;
  slider.addEventListener("input", () => clock.set(+slider.value));
  slider.addEventListener("keydown", clock.key);
  clock.onCursor.push((t) => {
    slider.value = t;
    const reading = `${t.toFixed(2)} s` + (data.t0_ms === null ? "" : `   ${utcWords(t, 2)} UTC`);
    words.textContent = reading;
    slider.setAttribute("aria-valuetext", reading);
  });
  for (const [id, act] of [["pulse", clock.pulse], ["whole", clock.whole],
    ["closer", () => clock.zoom(0.6)], ["wider", () => clock.zoom(1 / 0.6)]]) {
    document.getElementById(id).addEventListener("click", act);
  }
}
