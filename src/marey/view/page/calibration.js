// The cameras of a calibration in space, the poses of the board, and the accuracy of points between them.
"use strict";

(() => {
  const body = JSON.parse(byId("data").textContent).rig;
  const decode = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const numbers = text => new Float32Array(decode(text).buffer);
  const boards = numbers(body.boards), points = numbers(body.points), sd = numbers(body.sd), floor = decode(body.floor);
  const shown = { boards: true, accuracy: false };
  const scene = makeScene(byId("scene"), byId("scene-problem"), { middle: body.middle, distance: 3.6 * body.reach, reach: [0.3, 60], lift: 0.5 });
  if (!scene) return;
  const CAMERA = [...rgb("#1d232b"), 0.9], BOARD = [...rgb("#2f6db5"), 0.45], FLOOR = [...rgb("#dc6f4a"), 1];
  const lines = [], marks = [], dots = [], size = 0.16 * body.reach;

  function inWorld(camera, x, y, z) {
    const R = camera.rotation, t = camera.translation, v = [x - t[0], y - t[1], z - t[2]];
    return [0, 1, 2].map(a => R[0][a] * v[0] + R[1][a] * v[1] + R[2][a] * v[2]);
  }
  for (const camera of body.cameras) {
    const [w, h] = camera.size, [fx, fy] = camera.focal, [cx, cy] = camera.centre, centre = inWorld(camera, 0, 0, 0);
    const corners = [[0, 0], [w, 0], [w, h], [0, h]].map(([x, y]) => inWorld(camera, size * (x - cx) / fx, size * (y - cy) / fy, size));
    corners.forEach((corner, k) => { lines.push([centre, corner, CAMERA]); lines.push([corner, corners[(k + 1) % 4], CAMERA]); });
    marks.push([centre, CAMERA]);
  }
  const outlines = [];
  for (let b = 0; b < body.count; b++) for (let k = 0; k < 4; k++) {
    const at = i => Array.from(boards.slice(12 * b + 3 * i, 12 * b + 3 * i + 3));
    outlines.push([at(k), at((k + 1) % 4), floor[b] ? FLOOR : BOARD]);
  }
  const sorted = Array.from(sd).sort((a, b) => a - b), low = sorted[Math.floor(0.05 * sorted.length)], high = sorted[Math.floor(0.95 * sorted.length)];
  for (let p = 0; p < sd.length; p++) {
    const share = Math.min(1, Math.max(0, (sd[p] - low) / Math.max(high - low, 1e-9)));
    dots.push([Array.from(points.slice(3 * p, 3 * p + 3)), [0.2 + 0.65 * share, 0.6 - 0.3 * share, 0.35 - 0.1 * share, 0.85]]);
  }
  const axes = ["#c0453f", "#3b7d4f", "#2f5d8a"].map((colour, a) => [[0, 0, 0], [0, 1, 2].map(b => (a === b ? 1 : 0)), [...rgb(colour), 1]]);
  // Names stand in a layer over the canvas, where the picture has the cameras.
  const canvas = byId("scene"), layer = document.createElement("div");
  layer.className = "names"; canvas.parentElement.appendChild(layer);
  const tags = body.cameras.map(camera => { const tag = document.createElement("span"); tag.textContent = camera.name; layer.appendChild(tag); return tag; });
  scene.draw = (view, lens, ratio) => {
    scene.drawLines([...lines, ...axes, ...(shown.boards ? outlines : [])]);
    scene.drawPoints(marks, 8 * ratio);
    if (shown.accuracy) scene.drawPoints(dots, 9 * ratio);
    const times = (m, v) => [0, 1, 2, 3].map(r => [0, 1, 2, 3].reduce((s, k) => s + m[4 * k + r] * v[k], 0));
    marks.forEach(([place], k) => {
      const q = times(lens, times(view, [...place, 1]));
      tags[k].hidden = q[3] <= 0;
      tags[k].style.left = `${(0.5 + 0.5 * q[0] / q[3]) * canvas.clientWidth + 8}px`;
      tags[k].style.top = `${(0.5 - 0.5 * q[1] / q[3]) * canvas.clientHeight - 6}px`;
    });
  };
  byId("show-boards").addEventListener("change", event => { shown.boards = event.target.checked; scene.later(); });
  byId("show-accuracy").addEventListener("change", event => { shown.accuracy = event.target.checked; scene.later(); });
  byId("go-round").addEventListener("change", event => scene.turn(event.target.checked));
  window.addEventListener("resize", scene.later);
  scene.later();
})();
