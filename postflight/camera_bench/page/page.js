"use strict";
const $ = (id) => document.getElementById(id);
const POSE = ["rotation_x_deg", "rotation_y_deg", "rotation_z_deg", "focal_factor"];
const HINTS = {
  "": "Step with the arrow keys; click into the history to go to a frame.",
  mask: "Click the region's corners, then close it: nothing is looked for inside.",
  rim: "Click points of the shell's edge; from five on they take the place of the edge found in this frame.",
  feature: "Click the same spot of the shell, by one name, in the benchmark frame and in this one.",
  erase: "Click near a mark or inside a mask to take it back.",
};
const NEAR_PX = 12;
let state = null, at = 0, shown = null, trying = false, corners = [], busy = false, again = false;
const pictures = new Map();

const said = (fault) => (fault ? `${fault.words} [${fault.code}]` : "");
const now = () => state.time_s[at];
const sameFrame = (edit) => edit.t_s !== null && Math.abs(edit.t_s - now()) < 1e-3;
const here = (edit) => sameFrame(edit) || (edit.edit === "mask" && edit.t_s === null);
const edit = (kind, more) => ({ edit: kind, name: "", note: "", t_s: now(), u_px: null, v_px: null, value: null, ...more });
const say = (words) => { $("status").textContent = words; };

async function ask(path, options) {
  const answer = await fetch(path, options);
  if (answer.ok) return answer.json();
  let words = `the bench answered ${answer.status}`;
  try { words = (await answer.json()).faults.map((fault) => `${fault.words} [${fault.code}]`).join("; "); } catch (_) { /* no JSON */ }
  throw new Error(words);
}

async function refresh() {
  try { state = await ask("state"); } catch (fault) { say(`the bench does not answer: ${fault.message}`); return; }
  $("camera").textContent = state.camera;
  $("file").textContent = state.file;
  $("at").max = state.time_s.length - 1;
  const done = state.answers.filter((one) => one !== null).length, all = state.time_s.length;
  const refused = state.answers.filter((one) => one !== null && one.refused).length;
  const camera = state.oriented ? `camera oriented on ${state.time_s[state.benchmark].toFixed(3)} s, rms ` +
    `${state.oriented.rms_px.toFixed(2)} px${state.oriented.remark ? "; " + state.oriented.remark : ""}` : said(state.trouble);
  say(`${camera}; ${done} of ${all} frames fitted, ${refused} refused`);
  listEdits();
  if (done < all && state.oriented) setTimeout(refresh, 700);
  await show();
}

async function save(edits) {
  try {
    state = await ask("edits", { method: "POST", headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ edits, revision: state.revision }) });
  } catch (fault) { say(`not saved: ${fault.message}`); return false; }
  trying = false;
  await refresh();
  return true;
}

const without = (unwanted) => state.edits.filter((one) => !unwanted(one));
const add = (...rows) => save([...state.edits, ...rows]);

function query() {
  const asked = new URLSearchParams();
  if (trying) { asked.set("theta_deg", $("theta").value); asked.set("plane_deg", $("plane").value); }
  if ($("try-pose").checked) for (const name of POSE) asked.set(name, $(name).value);
  return asked.size ? `?${asked}` : "";
}

function picture(index) {
  if (!pictures.has(index)) {
    if (pictures.size > 60) pictures.delete(pictures.keys().next().value);
    const image = new Image();
    image.src = `picture/${index}`;
    pictures.set(index, image.decode().then(() => image));
  }
  return pictures.get(index);
}

async function show() {
  // one request at a time; a slider that runs ahead is asked for once more at its end
  if (busy) { again = true; return; }
  busy = true;
  do {
    again = false;
    const wanted = at;
    try {
      const [image, points] = await Promise.all([picture(wanted), ask(`frame/${wanted}${query()}`)]);
      if (wanted === at) { shown = { image, points }; draw(); }
    } catch (fault) { say(fault.message); }
  } while (again);
  busy = false;
}

function draw() {
  const answer = state.answers[at], points = shown.points;
  $("time").textContent = `Frame ${at + 1} of ${state.time_s.length}, ${now().toFixed(3)} s` +
    (at === state.benchmark ? ", benchmark frame" : "");
  const rows = answer && !answer.refused ? [
    ["angle", `${answer.theta_deg.toFixed(2)} ± ${answer.theta_sd_deg.toFixed(2)} deg (1 sd)`],
    ["plane", answer.plane_sd_deg > 60 ? "undetermined at so small an angle" : `${answer.plane_lv_deg.toFixed(1)} ± ${answer.plane_sd_deg.toFixed(1)} deg LV`],
    ["residual", `${answer.rms_px.toFixed(2)} px rms`], ["edge points", answer.edge_points], ["rows of features", answer.features],
  ] : [];
  $("answer").replaceChildren(...rows.flatMap(([name, value]) => {
    const term = document.createElement("dt"), text = document.createElement("dd");
    term.textContent = name; text.textContent = value;
    return [term, text];
  }));
  $("refused").textContent = points.trouble || (answer ? said(answer.refused) : state.trouble ? said(state.trouble) : "not fitted yet");
  $("tried").textContent = points.rms_px === null ? "" : `${points.rms_px.toFixed(2)} px rms of all used, unweighted`;
  if (!trying && answer && !answer.refused) {
    $("theta").value = answer.theta_deg; $("plane").value = (answer.plane_lv_deg + 360) % 360;
  }
  $("theta-said").textContent = `${(+$("theta").value).toFixed(2)} deg`;
  $("plane-said").textContent = `${(+$("plane").value).toFixed(1)} deg LV`;
  $("at").value = at;
  drawPicture();
  drawHistory();
}

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

function drawPicture() {
  const canvas = $("picture"), pen = canvas.getContext("2d"), [width, height] = state.size_px;
  // drawn twice as fine as the frame: residuals are parts of a pixel
  canvas.width = 2 * width; canvas.height = 2 * height;
  pen.scale(2, 2);
  pen.drawImage(shown.image, 0, 0);
  pen.translate(0.5, 0.5); // pixel centres at integers
  const path = (points, closed) => {
    pen.beginPath();
    points.forEach(([u, v], k) => (k ? pen.lineTo(u, v) : pen.moveTo(u, v)));
    if (closed) pen.closePath();
    pen.stroke();
  };
  pen.lineWidth = 1;
  if ($("show-outline").checked) { pen.strokeStyle = colour("outline"); path(shown.points.outline); }
  const enlarged = +$("enlarged").value;
  const dots = (rows, size) => {
    for (const [u, v, du, dv, residual, used] of rows) {
      pen.strokeStyle = pen.fillStyle = colour(used ? "used" : "left");
      pen.lineWidth = 0.7;
      path([[u, v], [u + enlarged * residual * du, v + enlarged * residual * dv]]);
      pen.fillRect(u - size / 2, v - size / 2, size, size);
    }
  };
  if ($("show-features").checked) dots(shown.points.features, 1.5);
  if ($("show-edge").checked) dots(shown.points.edge, 2);
  if (!$("show-marks").checked) return;
  pen.strokeStyle = colour("marks"); pen.lineWidth = 1.5; pen.fillStyle = colour("marks"); pen.font = "11px sans-serif";
  for (const region of regions()) path(region.map((one) => [one.u_px, one.v_px]), true);
  if (corners.length) path(corners);
  for (const one of state.edits.filter((each) => sameFrame(each) && (each.edit === "rim" || each.edit === "feature"))) {
    pen.beginPath(); pen.arc(one.u_px, one.v_px, 4, 0, 7); pen.stroke();
    if (one.edit === "feature") pen.fillText(one.name, one.u_px + 6, one.v_px - 4);
  }
}

function regions() {
  const found = new Map();
  for (const one of state.edits.filter((each) => each.edit === "mask" && here(each))) {
    const key = `${one.t_s === null}/${one.name}`;
    found.set(key, [...(found.get(key) || []), one]);
  }
  return [...found.values()];
}

function drawHistory() {
  const canvas = $("history"), scale = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * scale; canvas.height = height * scale;
  const pen = canvas.getContext("2d");
  pen.scale(scale, scale);
  const t = state.time_s, first = t[0], span = Math.max(t[t.length - 1] - first, 1e-6);
  const highest = Math.max(1, ...state.answers.map((one) => (one && !one.refused ? one.theta_deg + one.theta_sd_deg : 0)));
  const x = (time) => 34 + (width - 44) * (time - first) / span, y = (angle) => height - 18 - (height - 28) * angle / highest;
  pen.fillStyle = pen.strokeStyle = colour("soft"); pen.font = "11px sans-serif"; pen.lineWidth = 1;
  pen.fillText(`${highest.toFixed(1)}°`, 4, y(highest) + 8); pen.fillText("0°", 4, y(0)); pen.fillText(`${first.toFixed(1)} s`, 34, height - 4);
  const end = `${t[t.length - 1].toFixed(1)} s`;
  pen.fillText(end, width - 10 - pen.measureText(end).width, height - 4);
  state.answers.forEach((one, k) => {
    if (one === null) return;
    if (one.refused) { pen.fillStyle = colour("left"); pen.fillRect(x(t[k]) - 1, height - 18, 2, 6); return; }
    pen.strokeStyle = pen.fillStyle = colour("accent");
    pen.beginPath(); pen.moveTo(x(t[k]), y(one.theta_deg + one.theta_sd_deg)); pen.lineTo(x(t[k]), y(Math.max(one.theta_deg - one.theta_sd_deg, 0))); pen.stroke();
    pen.fillRect(x(t[k]) - 1, y(one.theta_deg) - 1, 2.5, 2.5);
  });
  pen.strokeStyle = colour("ink");
  pen.beginPath(); pen.moveTo(x(now()), 4); pen.lineTo(x(now()), height - 14); pen.stroke();
}

function listEdits() {
  const rows = [], seen = new Set();
  state.edits.forEach((one) => {
    const group = one.edit === "mask" || one.edit === "rim" ? `${one.edit}/${one.name}/${one.t_s}` : null;
    if (group && seen.has(group)) return;
    seen.add(group);
    const item = document.createElement("li"), words = document.createElement("span"), gone = document.createElement("button");
    const when = one.t_s === null ? "" : ` at ${one.t_s.toFixed(3)} s`;
    words.textContent = `${one.edit} ${one.name}${when}${one.value === null ? "" : " = " + one.value}${one.note ? ": " + one.note : ""}`;
    gone.textContent = "remove";
    gone.setAttribute("aria-label", `remove ${words.textContent}`);
    gone.onclick = () => save(without((other) => (group ? `${other.edit}/${other.name}/${other.t_s}` === group : other === one)));
    item.append(words, gone);
    rows.push(item);
  });
  $("edits").replaceChildren(...rows);
  if (!$("try-pose").checked) for (const name of POSE) $(name).value = +state.pose[name].toFixed(4);
}

function go(index) {
  at = Math.max(0, Math.min(state.time_s.length - 1, index));
  trying = false; corners = [];
  show();
}

const mode = () => document.querySelector("input[name=mode]:checked").value;

function clicked(event) {
  const box = $("picture").getBoundingClientRect(), [width, height] = state.size_px;
  const u = (event.clientX - box.left) / box.width * width - 0.5, v = (event.clientY - box.top) / box.height * height - 0.5;
  const place = { u_px: +u.toFixed(2), v_px: +v.toFixed(2) };
  if (mode() === "rim") add(edit("rim", place));
  else if (mode() === "feature") {
    const name = $("name").value.trim() || "1";
    save([...without((one) => one.edit === "feature" && one.name === name && sameFrame(one)), edit("feature", { name, ...place })]);
  } else if (mode() === "mask") {
    corners.push([place.u_px, place.v_px]);
    $("close-mask").disabled = corners.length < 3;
    drawPicture();
  } else if (mode() === "erase") erase(u, v);
}

function erase(u, v) {
  const near = state.edits.filter((one) => sameFrame(one) && (one.edit === "rim" || one.edit === "feature"))
    .map((one) => [Math.hypot(one.u_px - u, one.v_px - v), one]).sort((a, b) => a[0] - b[0])[0];
  if (near && near[0] < NEAR_PX) { save(without((one) => one === near[1])); return; }
  const region = regions().find((each) => {
    // even-odd rule
    let inside = false;
    each.forEach((one, k) => {
      const other = each[(k + each.length - 1) % each.length];
      if ((one.v_px > v) !== (other.v_px > v) &&
        u < (other.u_px - one.u_px) * (v - one.v_px) / (other.v_px - one.v_px) + one.u_px) inside = !inside;
    });
    return inside;
  });
  if (region) save(without((one) => region.includes(one)));
}

async function closeMask() {
  const t_s = $("everywhere").checked ? null : now(), taken = new Set(state.edits.filter((one) => one.edit === "mask").map((one) => one.name));
  let name = $("name").value.trim() || "1";
  for (let k = 2; taken.has(name); k += 1) name = `${$("name").value.trim() || "mask"} ${k}`;
  const rows = corners.map(([u_px, v_px]) => edit("mask", { name, t_s, u_px, v_px }));
  corners = []; $("close-mask").disabled = true;
  await add(...rows);
}

const decided = (one) => (one.edit === "reject" || one.edit === "accept") && sameFrame(one);
const decide = (kind) => save([...without(decided), edit(kind, { note: $("note").value.trim() })]);

$("picture").onclick = clicked;
$("history").onclick = (event) => {
  const box = $("history").getBoundingClientRect(), t = state.time_s;
  const time = t[0] + (event.clientX - box.left - 34) / (box.width - 44) * (t[t.length - 1] - t[0]);
  go(t.reduce((best, one, k) => (Math.abs(one - time) < Math.abs(t[best] - time) ? k : best), 0));
};
$("at").oninput = () => go(+$("at").value);
$("before").onclick = () => go(at - 1);
$("after").onclick = () => go(at + 1);
$("first").onclick = () => go(0);
$("worst").onclick = () => {
  const refused = state.answers.map((one, k) => (one && one.refused ? k : -1)).filter((k) => k >= 0);
  if (refused.length) go(refused.find((k) => k > at) ?? refused[0]);
};
for (const id of ["theta", "plane"]) $(id).oninput = () => { trying = true; show(); };
$("own").onclick = () => { trying = false; show(); };
$("reject").onclick = () => decide("reject");
$("accept").onclick = () => decide("accept");
$("undecided").onclick = () => save(without(decided));
$("benchmark").onclick = () => save([...without((one) => one.edit === "benchmark"), edit("benchmark")]);
$("close-mask").onclick = closeMask;
for (const id of ["show-outline", "show-edge", "show-features", "show-marks", "enlarged"]) $(id).onchange = drawPicture;
for (const each of document.querySelectorAll("input[name=mode]")) each.onchange = () => { corners = []; $("hint").textContent = HINTS[mode()]; drawPicture(); };
for (const name of POSE) $(name).oninput = () => { $("try-pose").checked = true; show(); };
$("try-pose").onchange = show;
$("use-pose").onclick = async () => {
  const rows = POSE.map((name) => edit("pose", { name, t_s: null, value: +$(name).value }));
  if (await save([...without((one) => one.edit === "pose"), ...rows])) { $("try-pose").checked = false; refresh(); }
};
$("no-pose").onclick = () => { $("try-pose").checked = false; save(without((one) => one.edit === "pose")); };
addEventListener("resize", () => shown && drawHistory());
addEventListener("keydown", (event) => {
  if (event.target.matches("input:not([type=radio]):not([type=checkbox]), select")) return;
  const keys = { ArrowLeft: () => go(at - 1), ArrowRight: () => go(at + 1), Home: () => go(0), End: () => go(state.time_s.length - 1),
    Enter: () => { if (corners.length >= 3) closeMask(); } };
  if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
});
$("hint").textContent = HINTS[""];
refresh().then(() => { if (state) go(state.benchmark); });
