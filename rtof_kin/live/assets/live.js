
// The live page: estimates, states and messages that come over a WebSocket. data-state of the root element is
// "waiting", "live", "stale" (connected, but no estimates), "lost" (trying again) or "failed".
const SPAN = 10;            // [s] of the curves
const STALE = 1000;         // [ms] without an estimate
const MOST_MESSAGES = 200;
const [PRIOR, BRIDGED, BOTH] = [1, 2, 5];  // provenance, see the description of the skeleton
const USUAL = ["knee flexion", "hip flexion", "elbow flexion"];
const root = document.documentElement, by_id = id => document.getElementById(id);

window.addEventListener("error", event => {
  root.dataset.state = "failed";
  root.dataset.error = event.message;
});

const mean = list => list.reduce((sum, value) => sum + value, 0) / list.length;
const digits = value => value.toFixed(value < 10 ? 1 : 0);

// Figures of the last second, and the largest of the last SPAN seconds.
function show_figures(frames) {
  const now = performance.now();
  const recent = frames.filter(frame => now - frame.at < STALE);
  const figure = (name, value, note) => {
    by_id(name).textContent = recent.length ? value() : "\u2013";
    if (recent.length && note) by_id(name + "-note").textContent = note();
  };
  const most = key => `at most ${digits(1000 * Math.max(...frames.map(frame => frame[key])))} in ${SPAN} s`;
  figure("lag", () => digits(1000 * mean(recent.map(frame => frame.lag))), () => most("lag"));
  figure("frame", () => digits(1000 * mean(recent.map(frame => frame.seconds))), () => most("seconds"));
  const seconds = recent.length ? (recent[recent.length - 1].at - recent[0].at) / 1000 : 0;
  figure("rate", () => seconds < 0.5 ? "\u2013" : ((recent.length - 1) / seconds).toFixed(0));
}

// Pairs of right and left angles by clinical name: name -> [{side, sign, index, joint}].
function angle_groups(skeleton) {
  const groups = new Map();
  skeleton.angles.forEach((angle, index) => {
    const [, side, name] = /^(?:(right|left) )?(.*)$/.exec(angle.clinical);
    const joint = skeleton.joints.indexOf(angle.joint);
    if (!groups.has(name)) groups.set(name, []);
    groups.get(name).push({side: side || "", sign: angle.sign, index, joint});
  });
  return groups;
}

// Degrees of an angle in frames; NaN where it was not observed, and before a jump to another turn.
function degrees(frames, {index, sign, joint}) {
  let before = NaN;
  return frames.map(frame => {
    const seen = frame.q.length && !(frame.sourced && frame.provenance[joint] <= PRIOR);
    const y = seen ? sign * frame.q[index] * 180 / Math.PI : NaN;
    const jump = Math.abs(y - before) > 180;
    before = y;
    return jump ? NaN : y;
  });
}

// Round ends that hold the values; they stay until they are much too wide.
function steady_range(series, before) {
  const [low, high] = extent(series).map((v, i) => 10 * (i ? Math.ceil(v / 10) : Math.floor(v / 10)));
  if (!before || before[1] - before[0] > 1.6 * (high - low) + 20) return [low, high];
  return [Math.min(low, before[0]), Math.max(high, before[1])];
}

// A chart whose angle can be chosen; returns a function that draws it from frames.
function start_chart(parent, groups, first) {
  const figure = element("figure", "", parent);
  const select = element("select", "", figure);
  select.setAttribute("aria-label", "angle");
  for (const name of groups.keys()) element("option", name, select).value = name;
  select.value = first;
  const {width, height} = SIZE;
  const picture = svg("svg", {viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "angle over time"}, figure);
  const caption = element("figcaption", "", figure);
  let range = null;
  select.addEventListener("change", () => { range = null; });
  return frames => {
    const now = frames.length ? frames[frames.length - 1].time : 0;
    const x = frames.map(frame => frame.time - now);
    const series = groups.get(select.value).map(angle => ({side: angle.side, y: degrees(frames, angle)}));
    range = steady_range(series, range);
    const axis = {x: [-SPAN, 0], label: "time [s], now at the right"};
    const scale = scales({series, range}, axis);
    picture.replaceChildren();
    draw_axes(picture, axis, scale);
    for (const one of series) draw_curve(picture, one, x, scale);
    caption.replaceChildren();
    for (const {side, y} of series) {
      const last = y.length ? y[y.length - 1] : NaN;
      const text = Number.isNaN(last) ? "not observed" : `${last.toFixed(0)} deg`;
      element("span", `${side} ${text}  `, caption).className = side || "both";
    }
  };
}

// Body for start_scene from a frame; the floor is that of the setup, or follows the lowest joint.
function body_of(frame, skeleton, floor) {
  const at = joint => frame.p[joint] ? [frame.p[joint][0], frame.p[joint][1], frame.p[joint][2] - floor] : [NaN, NaN, NaN];
  const pelvis = at(0), known = !Number.isNaN(pelvis[0]);
  const look = joint => {
    const source = frame.provenance[joint];
    if (source <= PRIOR || !frame.valid[joint]) return {colour: themed("prior")};
    if (source === BRIDGED) return {colour: themed("predicted"), dash: true};
    return {colour: themed(source === BOTH ? "seen-by-both" : "seen-by-one")};
  };
  const [x, y] = known ? pelvis : [0, 0];
  return {
    joints: skeleton.joints, parents: skeleton.parents, at, look,
    target: [x, y, 0.52 * skeleton.height_m], radius: 0.7 * skeleton.height_m,
    floor: [Math.round(2 * x) / 2, Math.round(2 * y) / 2], reach: 3,  // goes with the person, in whole squares
  };
}

function lowest_floor(before, frame) {
  const heights = frame.p.filter(p => p).map(p => p[2] - 0.08);
  if (!heights.length) return before;
  const low = Math.min(...heights);
  return before === null ? low : before + (low < before ? 0.1 : 0.002) * (low - before);
}

function show_status(status) {
  const rows = by_id("stream-rows");
  const camera = status.camera && status.camera.state ? [{name: "camera", ...status.camera}] : [];
  const kinds = {ok: "pass", lost: "fail", frozen: "fail"};
  rows.replaceChildren();
  for (const one of [...(status.sensors || []), ...camera]) {
    const row = element("tr", "", rows);
    element("td", String(one.name), row);
    const badge = element("span", String(one.state), element("td", "", row));
    badge.className = "grade " + (kinds[one.state] || "warn");
    const rate = typeof one.rate_hz === "number" ? `${one.rate_hz.toFixed(0)} Hz` : "";
    element("td", [rate, one.sentence].filter(Boolean).join("; "), row);
  }
}

function show_message(sentence) {
  const list = by_id("messages"), entry = document.createElement("li");
  element("time", new Date().toLocaleTimeString(), entry);
  entry.append(String(sentence));
  list.prepend(entry);
  while (list.children.length > MOST_MESSAGES) list.lastChild.remove();
}

function show_connection(state) {
  const looks = {
    waiting: ["waiting for the first pose", "not-checked"], live: ["live", "pass"],
    stale: ["connected, but no pose comes", "warn"], lost: ["connection lost, trying again", "fail"],
  };
  const [text, kind] = looks[state], badge = by_id("connection");
  if (root.dataset.state === state || root.dataset.state === "failed") return;
  root.dataset.state = state;
  document.body.classList.toggle("stale", state !== "live");
  badge.textContent = text;
  badge.className = "grade " + kind;
}

(() => {
  let skeleton = null, charts = [], paint_scene = null, floor = null, fixed_floor = false;
  let frames = [], dirty = false, told = false, connected = false, wait = 250;

  function paint() {
    dirty = false;
    if (!paint_scene || !frames.length) return;
    paint_scene(body_of(frames[frames.length - 1], skeleton, floor || 0));
  }

  function begin(found) {
    fixed_floor = typeof found.floor_m === "number";
    floor = fixed_floor ? found.floor_m : null;
    frames = [];
    by_id("messages").replaceChildren();  // the server tells the last ones again
    const same = skeleton && JSON.stringify(skeleton) === JSON.stringify(found.skeleton);
    skeleton = found.skeleton;
    if (same) return;
    const groups = angle_groups(skeleton), names = [...groups.keys()];
    const first = USUAL.map((name, i) => groups.has(name) ? name : names[i % names.length]);
    by_id("angle-charts").replaceChildren();
    charts = first.map(name => start_chart(by_id("angle-charts"), groups, name));
    if (!paint_scene) paint_scene = start_scene(by_id("scene"), skeleton.height_m, paint);
  }

  function take(state) {
    const stamp = state.header.stamp, time = stamp.sec + 1e-9 * stamp.nanosec, at = performance.now();
    const last = frames[frames.length - 1];
    if (last && (time <= last.time || time - last.time > SPAN)) frames = [];  // another recording, or a jump
    const {position: p, valid, provenance} = state.joints, sourced = provenance.some(source => source > 0);
    frames.push({time, at, q: state.position, p, valid, provenance, sourced, lag: state.lag_s, seconds: state.frame_s});
    while (time - frames[0].time > SPAN) frames.shift();
    if (!fixed_floor) floor = lowest_floor(floor, frames[frames.length - 1]);
    if (!dirty) { dirty = true; requestAnimationFrame(paint); }
  }

  function connect() {
    const socket = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}${location.pathname}`);
    socket.onopen = () => { connected = true; wait = 250; };
    socket.onmessage = event => {
      const found = JSON.parse(event.data);
      if (found.skeleton) begin(found);
      else if (found.header && skeleton) take(found);
      else if (found.status) show_status(found.status);
      else if (found.message) show_message(found.message);
    };
    socket.onclose = () => {
      connected = false;
      setTimeout(connect, wait);
      wait = Math.min(2 * wait, 4000);
    };
  }

  setInterval(() => {
    const newest = frames.length ? performance.now() - frames[frames.length - 1].at : Infinity;
    if (!connected) show_connection(told || frames.length ? "lost" : "waiting");
    else if (!frames.length) show_connection("waiting");
    else show_connection(newest < STALE ? "live" : "stale");
    told = told || connected;
    if (document.hidden) return;
    show_figures(frames);
    if (newest < STALE) for (const draw of charts) draw(frames);
  }, 125);
  connect();
})();
