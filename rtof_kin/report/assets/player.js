
// The skeleton in 3D: drag to turn, wheel to zoom, a slider for time. moved(t) is called with the time.
function start_player(data, moved) {
  const canvas = document.getElementById("scene"), pen = canvas.getContext("2d");
  const [play, slider, clock, speed, follow] =
    ["play", "time", "clock", "speed", "follow"].map(id => document.getElementById(id));
  const J = data.joints.length, T = data.times.length;
  const p = unpack(data.p, 1000), valid = unpack(data.valid, 100);
  const side = data.joints.map(name => /^(Left|l(?=[A-Z]))/.test(name) ? "left" : /^(Right|r(?=[A-Z]))/.test(name) ? "right" : "middle");
  const unseen = (frame, joint) => data.unseen[joint].some(([first, stop]) => first <= frame && frame < stop);
  const view = {yaw: -0.9, pitch: 0.15, zoom: 1};
  let now = data.times[0], playing = false, before = 0;
  slider.max = T - 1;

  const at = (frame, joint) => [0, 1, 2].map(k => p[3 * (frame * J + joint) + k]);
  // Radius of the scene.
  let reach = 0.6 * data.height;
  for (let f = 0; f < T; f++) {
    const [x, y] = at(f, 0);
    if (!Number.isNaN(x)) reach = Math.max(reach, Math.hypot(x, y) + 0.3 * data.height);
  }

  function camera(frame) {
    const root = at(frame, 0), known = follow.checked && !Number.isNaN(root[0]);
    const target = [known ? root[0] : 0, known ? root[1] : 0, 0.52 * data.height];
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    const distance = 5 * data.height;
    const least = Math.min(canvas.width / (2 * (known ? 0.7 * data.height : reach)), canvas.height / (1.25 * data.height));
    return point => {
      const [x, y, z] = point.map((v, k) => v - target[k]);
      const away = x * cy + y * sy, across = -x * sy + y * cy;
      const depth = distance - (away * cp + z * sp);
      const scale = view.zoom * least * distance / Math.max(depth, 0.1);
      return [canvas.width / 2 + across * scale, canvas.height / 2 - (z * cp - away * sp) * scale, scale];
    };
  }

  function paint() {
    const frame = nearest(data.times, now), style = getComputedStyle(document.documentElement);
    const colour = name => style.getPropertyValue("--" + name).trim();
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const see = camera(frame);
    pen.lineCap = "round";
    pen.strokeStyle = colour("line");
    pen.lineWidth = ratio;
    const edge = Math.ceil(2 * Math.max(reach, 1.5)) / 2;
    pen.beginPath();
    for (let i = -edge; i <= edge + 1e-9; i += 0.5)
      for (const [a, b] of [[[i, -edge, 0], [i, edge, 0]], [[-edge, i, 0], [edge, i, 0]]]) {
        pen.moveTo(...see(a).slice(0, 2));
        pen.lineTo(...see(b).slice(0, 2));
      }
    pen.stroke();
    const seen = valid[frame] > 0;
    const shade = joint => colour(seen && !unseen(frame, joint) ? side[joint] : "unseen");
    data.parents.forEach((parent, joint) => {
      if (parent < 0) return;
      const a = at(frame, parent), b = at(frame, joint);
      if (Number.isNaN(a[0] + b[0])) return;
      const [xa, ya, scale] = see(a), [xb, yb] = see(b);
      pen.strokeStyle = shade(joint);
      pen.lineWidth = Math.max(2 * ratio, 0.035 * scale);
      pen.beginPath();
      pen.moveTo(xa, ya);
      pen.lineTo(xb, yb);
      pen.stroke();
    });
    for (let joint = 0; joint < J; joint++) {
      const place = at(frame, joint);
      if (Number.isNaN(place[0])) continue;
      const [x, y, scale] = see(place);
      pen.fillStyle = shade(joint);
      pen.beginPath();
      pen.arc(x, y, Math.max(2.5 * ratio, (data.joints[joint] === "Head" ? 0.09 : 0.028) * scale), 0, 2 * Math.PI);
      pen.fill();
    }
    slider.value = frame;
    clock.textContent = data.times[frame].toFixed(2) + " s" + (seen ? "" : ", not observed");
    moved(data.times[frame]);
  }

  function go(time) { now = Math.min(Math.max(time, data.times[0]), data.times[T - 1]); paint(); }

  function tick(stamp) {
    if (!playing) return;
    if (before) now += (stamp - before) / 1000 * Number(speed.value);
    before = stamp;
    if (now > data.times[T - 1]) now = data.times[0];
    paint();
    requestAnimationFrame(tick);
  }

  function toggle() {
    playing = !playing;
    play.textContent = playing ? "pause" : "play";
    before = 0;
    if (playing) requestAnimationFrame(tick);
  }

  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => go(data.times[Number(slider.value)]));
  follow.addEventListener("change", paint);
  canvas.addEventListener("keydown", event => { if (event.key === " ") { event.preventDefault(); toggle(); } });
  canvas.addEventListener("pointerdown", event => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", event => {
    if (!(event.buttons & 1)) return;
    view.yaw -= 0.01 * event.movementX;
    view.pitch = Math.min(1.5, Math.max(-1.5, view.pitch + 0.01 * event.movementY));
    paint();
  });
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    view.zoom = Math.min(8, Math.max(0.3, view.zoom * Math.exp(-0.001 * event.deltaY)));
    paint();
  }, {passive: false});
  window.addEventListener("resize", paint);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
  window.addEventListener("beforeprint", paint);
  paint();
  return go;
}
