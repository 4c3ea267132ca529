// Recovered points in three dimensions: where they are, how certain that is, and what joins them.
"use strict";

function makeShapes(canvas, problem, body) {
  const P = body.count, place = floats(body.place), sd = floats(body.sd), predicted = new Uint8Array(bytes(body.predicted));
  const rotation = floats(body.rotation), origin = floats(body.origin), shown = { lines: true, intervals: false, trails: false, names: false };
  const scene = makeScene(canvas, problem, { middle: [0, 0, 0], distance: 4.4, reach: [0.5, 40] });
  if (!scene) return null;
  const { gl, drawLines, drawPoints, later } = scene;
  const SEEN = [...rgb("#2f6db5"), 1], GUESSED = [...rgb("#dc6f4a"), 1], LINE = [0.35, 0.4, 0.46, 0.75], INTERVAL = [...rgb("#b0791f"), 0.8];
  const AXES = ["#c0453f", "#3b7d4f", "#2f5d8a"];
  let frame = 0, motion = "turns";

  // A vector of the object's frame as it is to be seen; with `at` a place, else a direction.
  function seen(f, v, at = true) {
    if (motion === "still") return v;
    const moved = motion === "moves" && at;
    return [0, 1, 2].map(a => (moved ? origin[3 * f + a] : 0) + [0, 1, 2].reduce((s, b) => s + rotation[9 * f + 3 * a + b] * v[b], 0));
  }
  const raw = (f, p) => [0, 1, 2].map(a => place[3 * (f * P + p) + a]);
  const known = v => v[0] === v[0];
  function intervals(points) {
    const made = [];
    points.forEach((point, p) => {
      for (let a = 0; a < 3; a++) {
        const half = 1.96 * sd[3 * (frame * P + p) + a];
        if (!known(point) || half !== half) continue;
        const reach = seen(frame, [0, 1, 2].map(b => a === b ? half : 0), false);
        made.push([point.map((v, i) => v - reach[i]), point.map((v, i) => v + reach[i]), INTERVAL]);
      }
    });
    return made;
  }
  function trails() {
    const made = [], from = Math.max(1, frame - 60);
    for (let p = 0; p < P; p++) for (let f = from; f <= frame; f++) {
      const a = seen(f - 1, raw(f - 1, p)), b = seen(f, raw(f, p));
      if (known(a) && known(b)) made.push([a, b, [...SEEN.slice(0, 3), 0.15 + 0.5 * (f - from) / 60]]);
    }
    return made;
  }
  const writeNames = makeNames(canvas, body.labels);
  scene.draw = (view, lens, ratio) => {
    const points = Array.from({ length: P }, (_, p) => seen(frame, raw(frame, p)));
    const corner = seen(frame, [0, 0, 0]);
    if (known(corner)) drawLines(AXES.map((colour, a) => [corner, seen(frame, [0, 1, 2].map(b => a === b ? 0.25 : 0)), [...rgb(colour), 0.9]]));
    if (shown.trails) drawLines(trails());
    if (shown.lines) drawLines(body.lines.filter(([a, b]) => known(points[a]) && known(points[b])).map(([a, b]) => [points[a], points[b], LINE]));
    if (shown.intervals) drawLines(intervals(points));
    const dots = [];
    points.forEach((point, p) => { if (known(point)) dots.push([point, predicted[frame * P + p] ? GUESSED : SEEN]); });
    drawPoints(dots, 9 * ratio);
    writeNames(shown.names, points, view, lens);
  };
  return {
    show(next) { frame = next; later(); },
    answered(f) { return rotation[9 * f] === rotation[9 * f]; },
    move(how) { motion = how; later(); },
    toggle(what, on) { shown[what] = on; later(); },
    goRound: scene.turn,
  };
}

const shapes = makeShapes(byId("scene"), byId("scene-problem"), data.shapes), player = makePlayer();
followers.push(fromUser => {
  player.follow(!shapes || shapes.answered(current) ? "" : "no result");
  if (shapes) shapes.show(current);
  if (fromUser) player.stop();
});
if (shapes) {
  byId("motion").addEventListener("change", event => shapes.move(event.target.value));
  for (const what of ["lines", "intervals", "trails", "names"]) byId("show-" + what).addEventListener("change", event => shapes.toggle(what, event.target.checked));
  byId("go-round").addEventListener("change", event => shapes.goRound(event.target.checked));
  window.addEventListener("resize", () => shapes.show(current));
}
// report.html#frame=120 opens at that frame.
const linked = /frame=(\d+)/.exec(location.hash);
showFrame(linked ? Math.round(Number(linked[1]) / data.stride) : 0, false);
