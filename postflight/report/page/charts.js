// Time panels: one chart each, all with the clock's cursor and window.

const charts = [];
const GUTTER = 62, HEIGHT = 168, TALL = 250, SMALL = 118, FONT = "12px system-ui, sans-serif";

function translucent(colour, share) {
  const [r, g, b] = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
  return `rgba(${r},${g},${b},${share})`;
}

// times, values, and edges of the band of three sd of one line; the band ends at the panel's floor
function edges(line, panel) {
  const floor = panel.floor === undefined ? -Infinity : panel.floor;
  const part = (sign) => line.y.map((y, k) =>
    (y === null || line.sd[k] === null ? null : Math.max(y + sign * 3 * line.sd[k], floor)));
  const t = line.t || data[panel.time];
  if (line.low) return { t, y: line.y, low: line.low, high: line.high };
  if (line.sd) return { t, y: line.y, low: part(-1), high: part(1) };
  return { t, y: line.y };
}

function chartData(parts) {
  const tables = parts.map((e) => (e.low ? [e.t, e.y, e.low, e.high] : [e.t, e.y]));
  if (tables.every((table) => table[0] === tables[0][0])) return [tables[0][0], ...tables.flatMap((table) => table.slice(1))];
  return uPlot.join(tables);
}

function clipped(u, draw) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  draw(ctx, bbox, window.devicePixelRatio);
  ctx.restore();
}

// vertical lines with the numbers of the table of events, in two rows where they stand close
function drawEvents(u, numbered) {
  clipped(u, (ctx, bbox, ratio) => {
    ctx.strokeStyle = ctx.fillStyle = data.colours.soft;
    ctx.lineWidth = ratio;
    ctx.font = `${10 * ratio}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    ctx.textBaseline = "top";
    const ends = [-Infinity, -Infinity];
    data.events.forEach((event, k) => {
      const x = Math.round(u.valToPos(event.t, "x", true));
      ctx.setLineDash([2 * ratio, 3 * ratio]);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      const row = ends.findIndex((end) => x > end);
      if (!numbered || row < 0 || x < bbox.left) return;
      ctx.fillText(k + 1, x + 3 * ratio, bbox.top + (2 + 12 * row) * ratio);
      ends[row] = x + 14 * ratio;
    });
  });
}

// dots at their own times; crosses where bad; triangles at the edge for what lies outside
function drawPoints(u, points, size) {
  clipped(u, (ctx, bbox, ratio) => {
    const low = u.scales.y.min, high = u.scales.y.max, bad = new Set(points.bad || []);
    const first = Math.max(rowBefore(points.t, u.scales.x.min) - 1, 0);
    const s = size * ratio * (points.t.length < 400 ? 2 : 1);
    ctx.lineWidth = 1.5 * ratio;
    for (let k = first; k < points.t.length && points.t[k] <= u.scales.x.max; k++) {
      const y = points.y[k], x = u.valToPos(points.t[k], "x", true);
      if (y === null) continue;
      ctx.fillStyle = ctx.strokeStyle = bad.has(k) ? data.colours.bad : points.colour;
      if (y > high || y < low) {
        const up = y > high, base = up ? bbox.top + 7 * ratio : bbox.top + bbox.height - 7 * ratio;
        ctx.beginPath();
        ctx.moveTo(x - 3.5 * ratio, base);
        ctx.lineTo(x + 3.5 * ratio, base);
        ctx.lineTo(x, base + (up ? -6 : 6) * ratio);
        ctx.fill();
      } else if (bad.has(k)) {
        const at = u.valToPos(y, "y", true), arm = 3.5 * ratio;
        ctx.beginPath();
        ctx.moveTo(x - arm, at - arm); ctx.lineTo(x + arm, at + arm);
        ctx.moveTo(x - arm, at + arm); ctx.lineTo(x + arm, at - arm);
        ctx.stroke();
      } else ctx.fillRect(x - s / 2, u.valToPos(y, "y", true) - s / 2, s, s);
    }
  });
}

function axes(withUtc, small) {
  const grid = { stroke: data.colours.grid, width: 1 }, ticks = { stroke: data.colours.tick, width: 1, size: 5 };
  const look = { stroke: data.colours.soft, font: FONT, grid, ticks };
  const digits = (splits) => [0, 1, 2, 3].find((d) => splits.every((t) => Math.abs(t - t.toFixed(d)) < 1e-6)) ?? 3;
  return [
    { ...look, size: withUtc ? 46 : 30, space: withUtc ? 90 : 60, gap: 4,
      values: (u, splits) => splits.map((t) => `${t.toFixed(digits(splits))} s` + (withUtc && data.t0_ms !== null ? `\n${utcWords(t)}` : "")) },
    { ...look, size: GUTTER, gap: 6, space: small ? 18 : 28 },
  ];
}

// what is seen of lines and bands in the window, with a margin; raw samples may widen it, spikes may not flatten it
function scaleOf(panel) {
  return (u, low, high) => {
    if (panel.limit) return [-panel.limit, panel.limit];
    if (low === null || high === null) return [0, 1];
    const width = high - low || 1, from = low, to = high;
    for (const points of panel.raw) {
      for (let k = rowBefore(points.t, clock.from); k < points.t.length && points.t[k] <= clock.to; k++) {
        const y = points.y[k];
        if (points.t[k] < clock.from) continue;
        if (y >= from - width && y <= to + width) { low = Math.min(low, y); high = Math.max(high, y); }
      }
    }
    if (panel.ceiling !== undefined) high = Math.min(high, panel.ceiling);
    const margin = 0.06 * (high - low || 1);
    return [panel.floor === undefined ? low - margin : Math.max(low - margin, panel.floor), high + margin];
  };
}

function makeChart(panel, parts, series, bands, options) {
  const figure = document.getElementById(`panel-${panel.id}`), host = figure.querySelector(".plot");
  const u = new uPlot({
    width: host.clientWidth,
    height: options.height + (options.utc ? 16 : 0),
    padding: [8, 26, 0, 0],
    legend: { show: false },
    cursor: { x: false, y: false, points: { show: false }, drag: { x: true, y: false, setScale: false } },
    scales: { x: { time: false, range: () => [clock.from, clock.to] }, y: { range: scaleOf(panel) } },
    axes: axes(options.utc, options.height === SMALL),
    series: [{}, ...series],
    bands,
    hooks: {
      drawAxes: [(chart) => { drawEvents(chart, options.numbered); for (const p of panel.raw) drawPoints(chart, p, options.dot); }],
      setSelect: [(chart) => {
        if (chart.select.width < 4) return;
        const [from, to] = [0, chart.select.width].map((w) => chart.posToVal(chart.select.left + w, "x"));
        chart.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        clock.show(from, to);
      }],
    },
  }, parts, host);
  const cursor = document.createElement("div");
  cursor.className = "cursor";
  u.over.append(cursor);
  u.over.addEventListener("pointermove", (event) => { if (!event.buttons) clock.set(u.posToVal(event.offsetX, "x")); });
  u.over.addEventListener("click", (event) => clock.set(u.posToVal(event.offsetX, "x")));
  u.over.addEventListener("dblclick", clock.pulse);
  host.addEventListener("keydown", clock.key);
  const chart = { panel, u, figure, host, cursor, options, place };
  function place() {
    const inside = clock.now >= clock.from && clock.now <= clock.to;
    cursor.hidden = !inside;
    cursor.dataset.time = clock.now.toFixed(3);
    // a share, not pixels: right at any width, also on paper
    if (inside) cursor.style.left = `${(100 * (clock.now - clock.from) / (clock.to - clock.from)).toFixed(3)}%`;
  }
  charts.push(chart);
  return chart;
}

function swatch(line) {
  const name = "http://www.w3.org/2000/svg", svg = document.createElementNS(name, "svg");
  const mark = document.createElementNS(name, "line");
  for (const [key, value] of Object.entries({ width: 30, height: 8 })) svg.setAttribute(key, value);
  const look = { x1: 0, x2: 30, y1: 4, y2: 4, stroke: line.colour, "stroke-width": line.width, "stroke-dasharray": line.dash.join(" ") };
  for (const [key, value] of Object.entries(look)) mark.setAttribute(key, value);
  svg.append(mark);
  return svg;
}

// a button a line: its look, its name, its value at the cursor; pressing it hides or shows the line
function addLegend(chart, parts) {
  const legend = chart.figure.querySelector(".legend"), unit = chart.panel.unit ? ` ${chart.panel.unit}` : "";
  let index = 1;
  chart.panel.lines.forEach((line, k) => {
    const own = parts[k], count = own.low ? 3 : 1, from = index, value = document.createElement("b");
    index += count;
    const button = document.createElement("button");
    button.type = "button";
    button.setAttribute("aria-pressed", "true");
    button.append(swatch(line), line.label, value);
    button.addEventListener("click", () => {
      const shown = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", shown);
      for (let i = from; i < from + count; i++) chart.u.setSeries(i, { show: shown });
    });
    legend.append(button);
    clock.onCursor.push((t) => {
      // between frames a straight line is no answer with that sd: the nearest frame's value, with its time
      const inside = t >= own.t[0] && t <= own.t[own.t.length - 1];
      const at = line.dots && inside ? own.t[nearestRow(own.t, t)] : t;
      const y = between(own.t, line.y, at), sd = line.sd ? between(own.t, line.sd, at) : null;
      const least = Math.abs(y) >= 1000 ? 0 : Math.abs(y) >= 100 ? 1 : 2;
      const digits = sd > 0 ? Math.min(4, Math.max(least, -Math.floor(Math.log10(2 * sd)))) : least;
      value.textContent = y === null ? "–" : `${y.toFixed(digits)}${sd === null ? "" : ` ± ${sd.toFixed(digits)}`}${unit}${line.dots ? ` at ${at.toFixed(2)} s` : ""}`;
    });
  });
  for (const points of chart.panel.raw) {
    const words = document.createElement("span");
    words.textContent = `· ${points.label}` + (points.t.length < points.of ? ` (${points.t.length} of ${points.of})` : "");
    legend.append(words);
  }
}

function timePanel(panel, options) {
  const parts = panel.lines.map((line) => edges(line, panel)), series = [], bands = [];
  panel.lines.forEach((line, k) => {
    series.push({ stroke: line.colour, width: line.width, dash: line.dash, points: line.dots ? { show: true, size: 4, width: 0, fill: line.colour } : { show: false } });
    if (!parts[k].low) return;
    const edge = { stroke: "transparent", width: 0, points: { show: false } };
    bands.push({ series: [series.length + 2, series.length + 1], fill: translucent(line.colour, line.low ? 0.28 : 0.15) });
    series.push(edge, edge);
  });
  addLegend(makeChart(panel, chartData(parts), series, bands, { height: panel.id === "deflection" ? TALL : HEIGHT, dot: 1.6, ...options }), parts);
}

function residualPanel(panel, options) {
  const line = (factor) => panel.sd.map((sd) => factor * sd);
  const thin = { stroke: data.colours.soft, width: 1, points: { show: false } }, gate = { ...thin, stroke: data.colours.bad, dash: [6, 4] };
  const whole = { ...panel, lines: [], raw: [{ t: panel.t, y: panel.y, bad: panel.bad, colour: data.colours.residual }] };
  const chart = makeChart(whole, [panel.t, line(3), line(-3), line(panel.gate), line(-panel.gate)],
    [thin, thin, gate, gate], [], { height: SMALL, dot: 2, ...options });
  chart.figure.querySelector(".legend").textContent =
    `${panel.edited} of ${panel.of} edited` + (panel.t.length < panel.of ? `; ${panel.t.length} drawn, extremes kept` : "");
}

function startCharts() {
  data.panels.forEach((panel, k) => timePanel(panel, { numbered: true, utc: k === data.panels.length - 1 || k === 0 }));
  [...data.rigid, ...data.studies].forEach((panel) => timePanel(panel, { numbered: true, utc: true }));
  data.residuals.forEach((panel) => residualPanel(panel, { numbered: false, utc: false }));
  clock.onCursor.push(() => charts.forEach((chart) => chart.place()));
  clock.onWindow.push((from, to) => charts.forEach((chart) => {
    chart.u.batch(() => chart.u.setScale("x", { min: from, max: to }));
    chart.place();
  }));
  const fit = () => charts.forEach((chart) => {
    const width = chart.host.clientWidth, height = chart.u.height;
    if (width && width !== chart.u.width) chart.u.setSize({ width, height });
  });
  window.addEventListener("resize", fit);
  return fit;
}
