// The vehicle at the cursor's time: centerbody, deflected aeroshell and the wind, as shaded polygons on a canvas.
// Body axes: x out of the nose, which points down here; the relative wind comes from below. Far polygons are drawn first.

// rotation of points, mm, about the joint by the rotation vector x cross b (Rodrigues), b in deg
function rotation(b, times, joint) {
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
  const slider = document.getElementById("exaggeration"), factor = document.getElementById("exaggeration-words");
  const RAD = Math.PI / 180, view = { azimuth: 0, elevation: 24 * RAD };
  const parts = [
    { ...solid.forward, deflects: true, tone: () => [196, 186, 166] },
    { ...solid.aft, deflects: true, tone: (k) => (solid.aft.gores[k] % 2 ? [236, 226, 204] : [224, 211, 184]) },
    { ...solid.centerbody, deflects: false, tone: () => [150, 160, 170] },
  ];
  let wanted = false;

  // straight lines between answers, nothing in holes and outside
  function lateral(history, t, hole) {
    if (!history || !history.t.length || t < history.t[0] || t > history.t[history.t.length - 1]) return null;
    const k = rowBefore(history.t, t), n = Math.min(k + 1, history.t.length - 1), step = history.t[n] - history.t[k];
    if (hole && step > hole && t !== history.t[k]) return null;
    const s = step > 0 ? (t - history.t[k]) / step : 0;
    return [history.y[k] + s * (history.y[n] - history.y[k]), history.z[k] + s * (history.z[n] - history.z[k])];
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
    const deflection = lateral(data.poses.deflection, clock.now, data.poses.deflection && data.poses.deflection.hole);
    const flow = lateral(data.poses.flow, clock.now, 1), times = +slider.value, turn = rotation(deflection, times, solid.joint);
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
      const points = part.vertices.map((p) => (part.deflects ? turn(p) : p)).map(flat);
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
    path(solid.rim.map(flat), data.colours.soft, 1.6, [7, 6]);
    path(solid.rim.map(turn).map(flat), data.colours.ink, 2.4, []);
    const far = -1.35 * solid.length, nose = 0.3 * solid.length;
    path([[nose, 0, 0], [far, 0, 0]].map(flat), data.colours.soft, 1.6, [7, 6]);
    path([[nose, 0, 0], [far, 0, 0]].map(turn).map(flat), data.colours.ink, 2.4, []);
    describe(deflection, flow, times);
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

  // arrows of the relative wind, from ahead towards the vehicle; flow: lateral part of the velocity relative to the air, deg
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
    path([[x0, y0], [x1, y1]], data.colours.accent, 3, []);
    if (long < 4) return;
    const [dx, dy] = [(x1 - x0) / long, (y1 - y0) / long], s = Math.min(16, long / 2);
    ctx.fillStyle = data.colours.accent;
    ctx.beginPath();
    ctx.moveTo(x1 + dx * s * 0.4, y1 + dy * s * 0.4);
    ctx.lineTo(x1 - dx * s - dy * s * 0.45, y1 - dy * s + dx * s * 0.45);
    ctx.lineTo(x1 - dx * s + dy * s * 0.45, y1 - dy * s - dx * s * 0.45);
    ctx.fill();
  }

  function describe(deflection, flow, times) {
    const angle = deflection ? Math.hypot(deflection[0], deflection[1]) : null, towards = flow ? Math.hypot(flow[0], flow[1]) : null;
    canvas.dataset.deflection = angle === null ? "" : angle.toFixed(3);
    const plane = deflection ? ((Math.atan2(deflection[1], -deflection[0]) / RAD) + 360) % 360 : 0;
    words.textContent = (angle === null ? "No deflection at this time: drawn undeflected. "
      : `Deflection ${angle.toFixed(2)}° in the plane ${plane.toFixed(0)}° LV${times > 1 ? `, drawn ${times} times as large` : ""}. `) +
      (towards === null ? "Angle of attack not known. " : `Angle of attack ${towards.toFixed(1)}° (arrows: relative wind). `) +
      "Dashed: rim and axis undeflected.";
  }

  function redraw() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(draw);
  }

  function normalView() {
    const deflection = lateral(data.poses.deflection, clock.now) || [1, 0];
    view.azimuth = Math.atan2(deflection[1], deflection[0]) + Math.PI / 2;
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
    factor.textContent = +slider.value > 1 ? `${slider.value} times` : "as it is";
    redraw();
  });
  document.getElementById("across").addEventListener("click", normalView);
  document.getElementById("behind").addEventListener("click", () => { view.elevation = Math.PI / 2; redraw(); });
  clock.onCursor.push(redraw);
  normalView();
}
