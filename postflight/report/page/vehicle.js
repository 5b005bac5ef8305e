// The vehicle at the cursor's time: centerbody, bent shell and the air that meets it, as shaded polygons on a canvas.
// Body axes: x out of the nose, which points down here; the wind comes from below. Polygons far away are drawn first.

// turn points, mm, about the joint by the rotation vector x cross b (Rodrigues), b in deg
function bender(b, times, joint) {
  const size = b ? Math.hypot(b[0], b[1]) : 0;
  if (!size) return (p) => p;
  const angle = size * times * Math.PI / 180, c = Math.cos(angle), s = Math.sin(angle);
  const ky = -b[1] / size, kz = b[0] / size;
  return ([x0, y, z]) => {
    const x = x0 + joint, along = (ky * y + kz * z) * (1 - c);
    return [x * c + (ky * z - kz * y) * s - joint, y * c + kz * x * s + ky * along, z * c - ky * x * s + kz * along];
  };
}

function startVehicle() {
  const canvas = document.getElementById("vehicle");
  if (!canvas || !data.solid) return;
  const ctx = canvas.getContext("2d"), solid = data.solid, words = document.getElementById("vehicle-words");
  const slider = document.getElementById("exaggeration"), said = document.getElementById("exaggeration-words");
  const RAD = Math.PI / 180, view = { azimuth: 0, elevation: 24 * RAD };
  const parts = [
    { ...solid.forward, bends: true, tone: () => [196, 186, 166] },
    { ...solid.aft, bends: true, tone: (k) => (solid.aft.gores[k] % 2 ? [236, 226, 204] : [224, 211, 184]) },
    { ...solid.centerbody, bends: false, tone: () => [150, 160, 170] },
  ];
  let wanted = false;

  // straight lines between answers, nothing in holes and outside
  function lateral(told, t, hole) {
    if (!told || !told.t.length || t < told.t[0] || t > told.t[told.t.length - 1]) return null;
    const k = rowBefore(told.t, t), n = Math.min(k + 1, told.t.length - 1), step = told.t[n] - told.t[k];
    if (hole && step > hole && t !== told.t[k]) return null;
    const s = step > 0 ? (t - told.t[k]) / step : 0;
    return [told.y[k] + s * (told.y[n] - told.y[k]), told.z[k] + s * (told.z[n] - told.z[k])];
  }

  function axesOfView() {
    const { azimuth: a, elevation: e } = view;
    const to = [-Math.sin(e), Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a)];
    const up = [-Math.cos(e), -Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a)];
    const right = [up[1] * to[2] - up[2] * to[1], up[2] * to[0] - up[0] * to[2], up[0] * to[1] - up[1] * to[0]];
    return { to, up, right };
  }

  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

  function draw() {
    wanted = false;
    const bend = lateral(data.poses.bend, clock.now, data.poses.bend && data.poses.bend.hole);
    const flow = lateral(data.poses.flow, clock.now, 1), times = +slider.value, turn = bender(bend, times, solid.joint);
    const { to, up, right } = axesOfView(), w = canvas.width, h = canvas.height;
    const size = 0.41 * Math.min(w, h) / solid.radius, middle = [-0.22 * solid.length, 0, 0];
    const flat = (p) => {
      const d = [p[0] - middle[0], p[1], p[2]];
      return [w / 2 + size * dot(d, right), 0.5 * h - size * dot(d, up), dot(d, to)];
    };
    ctx.clearRect(0, 0, w, h);
    ctx.lineJoin = "round";
    const arrows = flow ? wind(flow) : [];
    for (const arrow of arrows.filter((a) => flat(a[0])[2] <= 0)) drawArrow(arrow, flat);
    const polygons = [];
    const light = [0.35, 0.75, 0.55];
    for (const part of parts) {
      const points = part.vertices.map((p) => (part.bends ? turn(p) : p)).map(flat);
      part.faces.forEach((face, k) => {
        const n = normal(face, points, size), shade = 0.55 + 0.45 * Math.abs(dot(n, light));
        const depth = face.reduce((sum, i) => sum + points[i][2], 0) / face.length;
        // what is seen from its inner side lies behind everything else
        polygons.push({ face, points, depth: n[2] > 0 ? depth : depth - 1e6, colour: part.tone(k).map((x) => Math.round(Math.min(255, x * shade * 1.04))) });
      });
    }
    polygons.sort((p, q) => p.depth - q.depth);
    ctx.lineWidth = 1;
    for (const { face, points, colour } of polygons) {
      ctx.fillStyle = ctx.strokeStyle = `rgb(${colour})`;
      ctx.beginPath();
      face.forEach((i, k) => ctx[k ? "lineTo" : "moveTo"](points[i][0], points[i][1]));
      ctx.closePath();
      ctx.fill();
      ctx.stroke();
    }
    for (const arrow of arrows.filter((a) => flat(a[0])[2] > 0)) drawArrow(arrow, flat);
    path(solid.rim.map(flat), "#57616b", 1.6, [7, 6]);
    path(solid.rim.map(turn).map(flat), "#1c2126", 2.4, []);
    const far = -1.35 * solid.length, nose = 0.3 * solid.length;
    path([[nose, 0, 0], [far, 0, 0]].map(flat), "#57616b", 1.6, [7, 6]);
    path([[nose, 0, 0], [far, 0, 0]].map(turn).map(flat), "#1c2126", 2.4, []);
    tell(bend, flow, times);
  }

  // of a polygon in the picture's axes, of length one
  function normal(face, points, size) {
    // by the diagonals: one side may have no length where a meridian begins on the axis
    const [a, b, c, d] = face.map((i) => points[i]);
    const u = [c[0] - a[0], a[1] - c[1], (c[2] - a[2]) * size], v = [d[0] - b[0], b[1] - d[1], (d[2] - b[2]) * size];
    const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    const length = Math.hypot(...n) || 1;
    return n.map((x) => x / length);
  }

  function path(points, colour, width, dash) {
    ctx.strokeStyle = colour;
    ctx.lineWidth = width;
    ctx.setLineDash(dash);
    ctx.beginPath();
    points.forEach(([x, y], k) => ctx[k ? "lineTo" : "moveTo"](x, y));
    ctx.stroke();
    ctx.setLineDash([]);
  }

  // arrows of the air, from ahead towards the vehicle; flow: lateral part of the velocity against the air, deg
  function wind(flow) {
    const total = Math.hypot(flow[0], flow[1]), angle = total * RAD, share = total ? Math.sin(angle) / total : 0;
    const ahead = [Math.cos(angle), share * flow[0], share * flow[1]], r = solid.radius;
    const out = [];
    for (let k = 0; k < 6; k++) {
      const side = [0, 0.75 * r * Math.cos(k * Math.PI / 3), 0.75 * r * Math.sin(k * Math.PI / 3)];
      const at = (far) => side.map((s, i) => s + far * r * ahead[i]);
      out.push([at(0.9), at(0.2)]);
    }
    return out;
  }

  function drawArrow([tail, head], flat) {
    const [x0, y0] = flat(tail), [x1, y1] = flat(head), long = Math.hypot(x1 - x0, y1 - y0);
    path([[x0, y0], [x1, y1]], "#005a8c", 3, []);
    if (long < 4) return;
    const [dx, dy] = [(x1 - x0) / long, (y1 - y0) / long], s = Math.min(16, long / 2);
    ctx.fillStyle = "#005a8c";
    ctx.beginPath();
    ctx.moveTo(x1 + dx * s * 0.4, y1 + dy * s * 0.4);
    ctx.lineTo(x1 - dx * s - dy * s * 0.45, y1 - dy * s + dx * s * 0.45);
    ctx.lineTo(x1 - dx * s + dy * s * 0.45, y1 - dy * s - dx * s * 0.45);
    ctx.fill();
  }

  function tell(bend, flow, times) {
    const angle = bend ? Math.hypot(bend[0], bend[1]) : null, towards = flow ? Math.hypot(flow[0], flow[1]) : null;
    canvas.dataset.bend = angle === null ? "" : angle.toFixed(3);
    const plane = bend ? ((Math.atan2(bend[1], -bend[0]) / RAD) + 360) % 360 : 0;
    words.textContent = (angle === null ? "No deflection is known at this time: drawn straight. "
      : `Shell bent ${angle.toFixed(2)}° in the plane ${plane.toFixed(0)}° LV${times > 1 ? `, drawn ${times} times as much` : ""}. `) +
      (towards === null ? "The angle of attack is not known. " : `Air (arrows) ${towards.toFixed(1)}° off the axis. `) +
      "Dashed: rim and axis not bent.";
  }

  function redraw() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(draw);
  }

  function across() {
    const bend = lateral(data.poses.bend, clock.now) || [1, 0];
    view.azimuth = Math.atan2(bend[1], bend[0]) + Math.PI / 2;
    view.elevation = 14 * RAD;
    redraw();
  }

  function turnView(right, up) {
    view.azimuth += right;
    view.elevation = Math.min(Math.max(view.elevation + up, -Math.PI / 2), Math.PI / 2);
    redraw();
  }

  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons) turnView(-event.movementX * 0.01, event.movementY * 0.01);
  });
  canvas.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!by) return;
    event.preventDefault();
    turnView(by[0] * 5 * RAD, by[1] * 5 * RAD);
  });
  slider.addEventListener("input", () => {
    said.textContent = +slider.value > 1 ? `${slider.value} times` : "as it is";
    redraw();
  });
  document.getElementById("across").addEventListener("click", across);
  document.getElementById("behind").addEventListener("click", () => { view.elevation = Math.PI / 2; redraw(); });
  clock.onCursor.push(redraw);
  across();
}
