
// Curves with bands as SVG: axes with units, a cursor, and the values under it.
const SIZE = {width: 460, height: 196, left: 54, right: 18, top: 8, bottom: 38};

const DENSE = 1500;  // samples from which on lines are thin

function svg(name, attributes, parent) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (parent) parent.appendChild(node);
  return node;
}

function element(name, text, parent) {
  const node = document.createElement(name);
  if (text) node.textContent = text;
  if (parent) parent.appendChild(node);
  return node;
}

// About `wanted` round numbers between two ends.
function ticks(low, high, wanted) {
  const rough = (high - low) / wanted;
  const power = Math.pow(10, Math.floor(Math.log10(rough)));
  const step = [1, 2, 5, 10].map(f => f * power).find(s => s >= rough) || 10 * power;
  const out = [];
  for (let i = Math.ceil(low / step); i * step <= high + 1e-9 * step; i++) out.push(i * step);
  return out;
}

// Index ranges of a curve without gaps.
function stretches(y) {
  const out = [];
  let start = -1;
  for (let i = 0; i <= y.length; i++) {
    const known = i < y.length && !Number.isNaN(y[i]);
    if (known && start < 0) start = i;
    if (!known && start >= 0) { out.push([start, i]); start = -1; }
  }
  return out;
}

// Ends of the values with their bands; those of doubtful samples count only where there is nothing else.
function extent(series, all) {
  let low = Infinity, high = -Infinity;
  for (const s of series) {
    const doubted = flags(s);
    for (let i = 0; i < s.y.length; i++) {
      const half = s.half && !Number.isNaN(s.half[i]) ? s.half[i] : 0;
      if (Number.isNaN(s.y[i]) || (doubted[i] && !all)) continue;
      low = Math.min(low, s.y[i] - half);
      high = Math.max(high, s.y[i] + half);
    }
  }
  if (!(low <= high)) return all ? [-1, 1] : extent(series, true);
  const room = Math.max(0.06 * (high - low), 1);
  return [low - room, high + room];
}

// 1 for each doubtful sample of a series.
function flags(series) {
  const out = new Uint8Array(series.y.length);
  for (const [start, stop] of series.doubtful || []) out.fill(1, start, stop);
  return out;
}

// Maps from values to SVG coordinates; chart.range is [low, high] where it is not the extent of the values.
function scales(chart, axis) {
  const {width, height, left, right, top, bottom} = SIZE;
  const [low, high] = chart.range || extent(chart.series);
  const first = axis.x[0], span = axis.x[axis.x.length - 1] - first || 1;
  return {
    low, high, first, last: first + span,
    X: x => left + (x - first) / span * (width - left - right),
    Y: y => top + (high - Math.min(Math.max(y, low), high)) / (high - low) * (height - top - bottom),
    x_under: place => first + (place - left) / (width - left - right) * span,
  };
}

function draw_axes(picture, axis, {low, high, first, last, X, Y}) {
  const {width, height, left, right, top, bottom} = SIZE;
  const foot = height - bottom, middle = (top + foot) / 2;
  const write = (text, attributes) => { svg("text", attributes, picture).textContent = text; };
  for (const y of ticks(low, high, 5)) {
    svg("line", {x1: left, x2: width - right, y1: Y(y), y2: Y(y), class: y === 0 ? "zero" : "grid"}, picture);
    write(+y.toFixed(2), {x: left - 5, y: Y(y) + 4, "text-anchor": "end"});
  }
  for (const x of ticks(first, last, 6)) {
    svg("line", {x1: X(x), x2: X(x), y1: top, y2: foot, class: "grid"}, picture);
    write(+x.toFixed(2), {x: X(x), y: foot + 14, "text-anchor": "middle"});
  }
  write(axis.label, {x: width - right, y: height - 4, "text-anchor": "end"});
  write("deg", {x: 15, y: middle, "text-anchor": "middle", transform: `rotate(-90 15 ${middle})`});
  for (const mark of axis.marks || [])
    svg("line", {x1: X(mark.at), x2: X(mark.at), y1: top, y2: foot, class: "toe " + mark.side}, picture);
}

function draw_band(picture, series, x, {X, Y}) {
  if (!series.half) return;
  const {y, half} = series;
  for (const [start, stop] of stretches(half.map((h, i) => h + 0 * y[i]))) {
    const edge = (i, sign) => `${X(x[i]).toFixed(1)} ${Y(y[i] + sign * half[i]).toFixed(1)}`;
    const there = [], back = [];
    for (let i = start; i < stop; i++) { there.push(edge(i, 1)); back.push(edge(i, -1)); }
    const d = "M" + there.concat(back.reverse()).join("L") + "Z";
    svg("path", {d, class: "band " + (series.side || "both")}, picture);
  }
}

function draw_curve(picture, series, x, {X, Y}) {
  const draw = (y, kind) => {
    for (const [start, stop] of stretches(y)) {
      const points = [];
      for (let i = start; i < stop; i++) points.push(`${X(x[i]).toFixed(1)} ${Y(y[i]).toFixed(1)}`);
      if (points.length === 1) points.push(points[0]);
      const d = "M" + points.join("L");
      svg("path", {d, class: "curve " + kind, "stroke-linecap": "round"}, picture);
    }
  };
  const side = (series.side || "both") + (x.length > DENSE ? " dense" : "");
  if (!series.doubtful) { draw(series.y, side); return; }
  // Doubtful stretches go to the samples beside them, so that the curve is not interrupted.
  const doubted = flags(series), near = i => doubted[i] || doubted[i - 1] || doubted[i + 1];
  draw(series.y.map((y, i) => near(i) ? y : NaN), "doubtful " + side);
  draw(series.y.map((y, i) => doubted[i] ? NaN : y), side);
}

// Caption of a chart: its series, or (read_off) the values at the cursor.
function describe(caption, chart) {
  caption.replaceChildren();
  for (const s of chart.series)
    element("span", (s.side || "") + (s.n ? ` (${s.n})` : "") + " ", caption).className = s.side || "both";
  if (chart.positive) caption.append("positive: " + chart.positive);
  if (chart.series.some(s => s.doubtful)) caption.append("; dotted: unreliable");
}

function read_off(caption, chart, axis, i) {
  caption.replaceChildren(`${axis.x[i].toFixed(axis.unit === "s" ? 2 : 0)} ${axis.unit}: `);
  for (const s of chart.series) {
    const half = s.half && !Number.isNaN(s.half[i]) ? ` \u00b1 ${s.half[i].toFixed(1)}` : "";
    const doubt = (s.doubtful || []).some(([start, stop]) => start <= i && i < stop) ? " (unreliable)" : "";
    const text = Number.isNaN(s.y[i]) ? "not observed" : s.y[i].toFixed(1) + half + doubt;
    element("span", `${s.side || ""} ${text}  `, caption).className = s.side || "both";
  }
  caption.append("deg");
}

// The chart in words: lowest and highest reliable value of each series, and where.
function in_words(chart, axis) {
  const place = i => `${axis.x[i].toFixed(axis.unit === "s" ? 1 : 0)} ${axis.unit || ""}`.trim();
  const one = s => {
    let low = -1, high = -1, known = 0, unsure = 0;
    const doubted = flags(s);
    for (let i = 0; i < s.y.length; i++) {
      if (Number.isNaN(s.y[i])) continue;
      known++;
      unsure += doubted[i];
      if (doubted[i]) continue;
      if (low < 0 || s.y[i] < s.y[low]) low = i;
      if (high < 0 || s.y[i] > s.y[high]) high = i;
    }
    const side = s.side ? s.side + ": " : "";
    if (low < 0) return side + (known ? "no reliable value" : "not observed");
    const seen = Math.floor(100 * known / s.y.length), share = Math.ceil(100 * unsure / known);
    const rest = (seen < 100 ? `, observed ${seen} % of the time` : "") + (share ? `, ${share} % of that unreliable` : "");
    return `${side}lowest ${s.y[low].toFixed(0)} deg at ${place(low)}, highest ${s.y[high].toFixed(0)} deg at ${place(high)}${rest}`;
  };
  const positive = chart.positive ? `, positive: ${chart.positive}` : "";
  return `${chart.name}${positive}. ${chart.series.map(one).join("; ")}.`;
}

// Heading of a chart; its name in OpenSim stands beside it where it has one, and the style shows one of both.
function head(chart, figure) {
  const title = element("h3", chart.opensim ? "" : chart.name, figure);
  if (!chart.opensim) return;
  element("span", chart.name, title).dataset.in = "isb xzy";
  element("span", chart.opensim, title).dataset.in = "opensim";
}

// chart: {name, positive, opensim, shown, series: [{side, y, half, n, doubtful}]}; axis: {x, label, unit, marks: [{at, side}]}.
// Returns a function that moves the cursor to an x, and writes the values there (read).
function draw_chart(parent, chart, axis, chosen) {
  const {width, height, top, bottom} = SIZE;
  const figure = element("figure", "", parent);
  if (chart.shown) figure.dataset.in = chart.shown;
  if (chart.further) figure.className = "further";
  head(chart, figure);
  const words = in_words(chart, axis);
  const picture = svg("svg", {viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": words}, figure);
  const scale = scales(chart, axis);
  draw_axes(picture, axis, scale);
  for (const series of chart.series) draw_band(picture, series, axis.x, scale);
  for (const series of chart.series) draw_curve(picture, series, axis.x, scale);
  const cursor = svg("line", {y1: top, y2: height - bottom, class: "cursor", visibility: "hidden"}, picture);
  const place = (x, read) => {
    if (read) read_off(caption, chart, axis, nearest(axis.x, x));
    cursor.setAttribute("visibility", "visible");
    cursor.setAttribute("x1", scale.X(x));
    cursor.setAttribute("x2", scale.X(x));
  };
  const caption = element("figcaption", "", figure);
  describe(caption, chart);
  const under = event => {
    const box = picture.getBoundingClientRect();
    return nearest(axis.x, scale.x_under((event.clientX - box.left) / box.width * width));
  };
  picture.addEventListener("pointermove", event => {
    const i = under(event);
    place(axis.x[i]);
    read_off(caption, chart, axis, i);
  });
  picture.addEventListener("pointerleave", () => describe(caption, chart));
  if (chosen) picture.addEventListener("click", event => chosen(axis.x[under(event)]));
  return place;
}

function unpack_series(group) {
  const y = s => group.turned ? unpack(s.y, 10).map(value => -value) : unpack(s.y, 10);
  return {...group, series: group.series.map(s => ({...s, y: y(s), half: s.half ? unpack(s.half, 10) : null}))};
}

// All charts of a section; returns a function that moves all cursors.
function draw_charts(parent, groups, axis, chosen) {
  const places = groups.map(group => draw_chart(parent, unpack_series(group), axis, chosen));
  return (x, read) => places.forEach(place => place(x, read));
}
