
const side_of = name => /^(Left|l(?=[A-Z]))/.test(name) ? "left" : /^(Right|r(?=[A-Z]))/.test(name) ? "right" : "middle";

// The skeleton playing in 3D, with a slider for time. moved(t, read) is called with the time; read: at a time that was chosen.
// film: {video, offset} plays beside it, at `offset` seconds more; it leads while it plays. Null: none.
function start_player(data, moved, film) {
  const canvas = document.getElementById("scene");
  const [play, slider, clock, speed, follow] =
    ["play", "time", "clock", "speed", "follow"].map(id => document.getElementById(id));
  const J = data.joints.length, T = data.times.length;
  const p = unpack(data.p, data.scale), valid = unpack(data.valid, 100);
  const side = data.joints.map(side_of);
  const unseen = (frame, joint) => data.unseen[joint].some(([first, stop]) => first <= frame && frame < stop);
  const paint_scene = start_scene(canvas, data.height, () => paint());
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)");  // stills, two a second
  let painted = 0;
  let now = data.times[data.first], playing = false, before = 0, chosen = false;
  slider.max = T - 1;

  const at = (frame, joint) => [0, 1, 2].map(k => p[3 * (frame * J + joint) + k]);
  // Radius of the scene.
  let reach = 0.6 * data.height;
  for (let f = 0; f < T; f++) {
    const [x, y] = at(f, 0);
    if (!Number.isNaN(x)) reach = Math.max(reach, Math.hypot(x, y) + 0.3 * data.height);
  }
  follow.checked = reach > 1.5 * data.height;  // a long way would leave the person small

  function paint() {
    const frame = nearest(data.times, now), seen = valid[frame] > 0;
    const root = at(frame, 0), known = follow.checked && !Number.isNaN(root[0]);
    paint_scene({
      joints: data.joints, parents: data.parents, floor: [0, 0], reach, at: joint => at(frame, joint),
      target: [known ? root[0] : 0, known ? root[1] : 0, 0.52 * data.height],
      radius: known ? 0.7 * data.height : reach,
      look: joint => ({colour: themed(seen && !unseen(frame, joint) ? side[joint] : "unseen")}),
    });
    slider.value = frame;
    clock.textContent = data.times[frame].toFixed(2) + " s" + (seen ? "" : ", not observed");
    moved(data.times[frame], chosen && !playing);
  }

  function seek() { if (film) film.video.currentTime = Math.max(now + film.offset, 0); }

  function go(time) { chosen = true; now = Math.min(Math.max(time, data.times[0]), data.times[T - 1]); seek(); paint(); }

  function tick(stamp) {
    if (!playing) return;
    const leads = film && !film.video.paused && film.video.readyState > 1;
    if (leads) now = Math.max(film.video.currentTime - film.offset, data.times[0]);
    else if (before) now += (stamp - before) / 1000 * Number(speed.value);
    before = stamp;
    if (now > data.times[T - 1]) { now = data.times[0]; seek(); }
    if (!calm.matches || stamp - painted >= 500) { painted = stamp; paint(); }
    requestAnimationFrame(tick);
  }

  function toggle() {
    playing = !playing;
    play.textContent = playing ? "pause" : "play";
    before = 0;
    if (film) {
      film.video.playbackRate = Number(speed.value);
      if (playing) film.video.play().catch(() => {}); else film.video.pause();
    }
    if (playing) requestAnimationFrame(tick);
  }

  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => go(data.times[Number(slider.value)]));
  follow.addEventListener("change", paint);
  speed.addEventListener("change", () => { if (film) film.video.playbackRate = Number(speed.value); });
  canvas.addEventListener("keydown", event => { if (event.key === " ") { event.preventDefault(); toggle(); } });
  for (const button of document.querySelectorAll(".views button"))
    button.addEventListener("click", () =>
      canvas.dispatchEvent(new KeyboardEvent("keydown", {key: button.dataset.key, cancelable: true})));
  seek();
  paint();
  return go;
}
