
// The motion beside its video on one time line; the range that is chosen goes to the page around this one.
window.addEventListener("error", event => {
  document.documentElement.dataset.state = "failed";
  document.documentElement.dataset.error = event.message;
});

// Part of the picture in which the person is seen, [left, top, width, height] px, with a margin.
function seen_part(image, points) {
  const [low, high] = [[Infinity, Infinity], [-Infinity, -Infinity]];
  points.forEach((value, i) => {
    if (Number.isNaN(value)) return;
    low[i % 2] = Math.min(low[i % 2], value);
    high[i % 2] = Math.max(high[i % 2], value);
  });
  const size = [image.width, image.height], margin = 0.15 * Math.max(high[0] - low[0], high[1] - low[1]);
  const ends = [0, 1].map(k => [Math.max(low[k] - margin, 0), Math.min(high[k] + margin, size[k])]);
  return ends.every(([a, b]) => b > a) ? [ends[0][0], ends[1][0], ends[0][1] - ends[0][0], ends[1][1] - ends[1][0]] : [0, 0, ...size];
}

// Draws the frame of the video, the skeleton and the detected points; returns paint(time).
function start_overlay(image, player, video, redraw) {
  const canvas = document.getElementById("image"), pen = canvas.getContext("2d");
  if (!image) return () => {};
  const points = unpack(image.uv, 1), found = unpack(image.detected, 1), sides = player.joints.map(side_of);
  const P = sides.length, L = image.landmarks, [x0, y0, width, height] = seen_part(image, points);
  window.addEventListener("resize", redraw);
  for (const moment of ["seeked", "loadeddata"]) video.addEventListener(moment, redraw);
  return time => {
    const ratio = window.devicePixelRatio || 1, frame = nearest(player.times, time);
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const scale = Math.min(canvas.width / width, canvas.height / height);
    const left = (canvas.width - scale * width) / 2, top = (canvas.height - scale * height) / 2;
    const at = (list, i) => [left + scale * (list[2 * i] - x0), top + scale * (list[2 * i + 1] - y0)];
    if (video.readyState > 1) {
      const zoom = video.videoWidth / image.width;  // a smaller copy of the video
      pen.drawImage(video, zoom * x0, zoom * y0, zoom * width, zoom * height, left, top, scale * width, scale * height);
    }
    pen.lineWidth = 3 * ratio;
    pen.lineCap = "round";
    player.parents.forEach((parent, child) => {
      if (parent < 0) return;
      const [xa, ya] = at(points, frame * P + parent), [xb, yb] = at(points, frame * P + child);
      if (Number.isNaN(xa + xb)) return;
      pen.strokeStyle = themed(sides[child]);
      pen.beginPath();
      pen.moveTo(xa, ya);
      pen.lineTo(xb, yb);
      pen.stroke();
    });
    pen.fillStyle = "#ffd54a";
    for (let i = 0; i < L; i++) {
      const [x, y] = at(found, frame * L + i);
      if (!Number.isNaN(x)) pen.fillRect(x - 2 * ratio, y - 2 * ratio, 4 * ratio, 4 * ratio);
    }
  };
}

// Spans on the time line; returns mark(kind, spans), which replaces those of a kind.
function start_line(times) {
  const line = document.getElementById("line"), first = times[0], length = times[times.length - 1] - first || 1;
  return (kind, spans) => {
    for (const old of line.querySelectorAll("." + kind)) old.remove();
    for (const [start, stop] of spans) {
      const span = element("span", "", line), [a, b] = [start, stop].map(t => Math.min(Math.max((t - first) / length, 0), 1));
      span.className = kind;
      span.style.left = 100 * a + "%";
      if (b > a) span.style.width = 100 * (b - a) + "%";
    }
  };
}

(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const video = document.getElementById("video"), label = document.getElementById("range");
  const times = data.player.times, move = {cursors: () => {}, go: () => {}}, range = [null, null];
  let now = times[0];
  const paint = start_overlay(data.image, data.player, video, () => paint(now)), mark = start_line(times);
  const axis = {x: data.angles.times, label: "time [s]", unit: "s", marks: data.strikes};
  move.cursors = draw_charts(document.getElementById("angle-charts"), data.angles.groups, axis, t => move.go(t));
  const film = video.getAttribute("src") ? {video, offset: data.offset} : null;
  video.addEventListener("error", () => { document.getElementById("image-help").textContent = data.unplayable; });
  move.go = start_player(data.player, (t, read) => {
    now = t;
    paint(t);
    move.cursors(t, read);
    mark("now", [[t, t]]);
  }, film);
  mark("mended", data.mended);
  mark("gone", data.gone.map(([first, stop]) => [times[first], times[Math.min(stop, times.length - 1)]]));
  function set(which, time) {
    range[which] = time;
    if (range[0] !== null && range[1] !== null && range[0] > range[1]) range.reverse();
    const [start, stop] = range.map(t => t === null ? "\u2026" : t.toFixed(2) + " s");
    const none = range[0] === null && range[1] === null;
    label.textContent = none ? "no range" : `${start} to ${stop}`;
    mark("chosen", none ? [] : [[range[0] ?? times[0], range[1] ?? times[times.length - 1]]]);
    window.parent.postMessage({range: [...range]}, window.location.origin);
  }
  const step = n => move.go(times[Math.min(Math.max(nearest(times, now) + n, 0), times.length - 1)]);
  const keys = {"[": () => set(0, now), "]": () => set(1, now), ",": () => step(-1), ".": () => step(1)};
  document.getElementById("from").addEventListener("click", keys["["]);
  document.getElementById("to").addEventListener("click", keys["]"]);
  document.getElementById("all").addEventListener("click", () => { set(0, null); set(1, null); });
  for (const button of document.querySelectorAll("[data-step]")) button.addEventListener("click", () => step(Number(button.dataset.step)));
  window.addEventListener("keydown", event => keys[event.key]?.());
  document.documentElement.dataset.state = "ready";
})();
