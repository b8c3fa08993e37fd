
// A skeleton on a floor in 3D: drag or arrow keys to turn, + and - to zoom; z is up, the floor at 0.
// The wheel zooms once the canvas has the focus; a finger turns it to the sides, and scrolls the page up and down.
// canvas: element; height: of the person; repaint(): called when the view changes.
// Returns paint(body) with {at(joint) -> [x, y, z] or NaN, joints, parents, target: [x, y, z] in the middle,
// radius: shown to either side, floor: [x, y] of its middle, reach: of the floor, look(joint) -> {colour, dash}},
// lengths in m.
function start_scene(canvas, height, repaint) {
  const pen = canvas.getContext("2d");
  const view = {yaw: -0.9, pitch: 0.15, zoom: 1};

  function camera(target, radius) {
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    const distance = 5 * height;
    const least = Math.min(canvas.width / (2 * radius), canvas.height / (1.25 * height));
    return point => {
      const [x, y, z] = point.map((v, k) => v - target[k]);
      const away = x * cy + y * sy, across = -x * sy + y * cy;
      const depth = distance - (away * cp + z * sp);
      const scale = view.zoom * least * distance / Math.max(depth, 0.1);
      return [canvas.width / 2 + across * scale, canvas.height / 2 - (z * cp - away * sp) * scale, scale];
    };
  }

  function paint_floor(see, [x, y], reach) {
    const edge = Math.ceil(2 * Math.max(reach, 1.5)) / 2;
    pen.beginPath();
    for (let i = -edge; i <= edge + 1e-9; i += 0.5)
      for (const [a, b] of [[[x + i, y - edge, 0], [x + i, y + edge, 0]], [[x - edge, y + i, 0], [x + edge, y + i, 0]]]) {
        pen.moveTo(...see(a).slice(0, 2));
        pen.lineTo(...see(b).slice(0, 2));
      }
    pen.stroke();
  }

  function paint(body) {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const see = camera(body.target, body.radius);
    pen.lineCap = "round";
    pen.strokeStyle = themed("line");
    pen.lineWidth = ratio;
    paint_floor(see, body.floor, body.reach);
    body.parents.forEach((parent, joint) => {
      if (parent < 0) return;
      const a = body.at(parent), b = body.at(joint);
      if (Number.isNaN(a[0] + b[0])) return;
      const [xa, ya, scale] = see(a), [xb, yb] = see(b), look = body.look(joint);
      const width = Math.max(2 * ratio, 0.035 * scale);
      pen.strokeStyle = look.colour;
      pen.lineWidth = width;
      pen.setLineDash(look.dash ? [0.6 * width, 1.8 * width] : []);
      pen.beginPath();
      pen.moveTo(xa, ya);
      pen.lineTo(xb, yb);
      pen.stroke();
    });
    pen.setLineDash([]);
    body.joints.forEach((name, joint) => {
      const place = body.at(joint);
      if (Number.isNaN(place[0])) return;
      const [x, y, scale] = see(place);
      pen.fillStyle = body.look(joint).colour;
      pen.beginPath();
      pen.arc(x, y, Math.max(2.5 * ratio, (name === "Head" ? 0.09 : 0.028) * scale), 0, 2 * Math.PI);
      pen.fill();
    });
  }

  function turn(yaw, pitch) {
    view.yaw += yaw;
    view.pitch = Math.min(1.5, Math.max(-1.5, view.pitch + pitch));
    repaint();
  }

  function zoom(factor) {
    view.zoom = Math.min(8, Math.max(0.3, view.zoom * factor));
    repaint();
  }

  const keys = {
    ArrowLeft: () => turn(0.1, 0), ArrowRight: () => turn(-0.1, 0),
    ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1), "+": () => zoom(1.1), "-": () => zoom(1 / 1.1),
  };
  canvas.addEventListener("keydown", event => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key]();
  });
  let last = [0, 0];
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    last = [event.clientX, event.clientY];
  });
  canvas.addEventListener("pointermove", event => {
    if (!(event.buttons & 1)) return;
    turn(-0.01 * (event.clientX - last[0]), 0.01 * (event.clientY - last[1]));
    last = [event.clientX, event.clientY];
  });
  canvas.addEventListener("wheel", event => {
    if (!event.ctrlKey && document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(-0.001 * event.deltaY));
  }, {passive: false});
  window.addEventListener("resize", repaint);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  return paint;
}

// Value of a colour of the style sheet, light or dark.
function themed(name) {
  return getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
}
