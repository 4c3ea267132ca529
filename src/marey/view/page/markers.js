// Skin markers and the frames of the bones beneath them, over time.
"use strict";

const markers = data.markers, M = markers.labels.length, S = markers.segments.length;
const markerPlace = floats(markers.place), boneOrigin = floats(markers.origin), boneRotation = floats(markers.rotation);
const markerRow = frame => Math.floor(frame / markers.every);
const known = v => v[0] === v[0];
const vector = (array, at) => [array[3 * at], array[3 * at + 1], array[3 * at + 2]];

// What a frame has, in words; also without the view.
function markerWords(frame) {
  const f = markerRow(frame), count = (array, total, width) => Array.from({ length: total }, (_, k) => array[width * (f * total + k)]).filter(v => v === v).length;
  return `${count(markerPlace, M, 3)} of ${M} markers, ${count(boneRotation, S, 9)} of ${S} bones`;
}

function makeMarkers(canvas, problem) {
  const filled = new Uint8Array(bytes(markers.filled)), middle = floats(markers.middle);
  const shown = { markers: true, bones: true, lines: true, trails: false, names: false, labels: false };
  const scene = makeScene(canvas, problem, { middle: [0, 0, 0], distance: 3.5, reach: [0.3, 40] });
  if (!scene) return null;
  const { drawLines, drawPoints, later } = scene;
  const colours = markers.colours.map(text => rgb(text)), other = rgb(markers.other), AXES = ["#c0453f", "#3b7d4f", "#2f5d8a"].map(text => [...rgb(text), 1]);
  const names = makeNames(canvas, markers.segments), labels = makeNames(canvas, markers.labels);
  let row = 0, follow = true;

  const colourOf = m => markers.owner[m] < 0 ? other : colours[markers.owner[m]];
  // A place as it is to be seen: relative to the middle of the markers in this frame, or in the laboratory.
  const seen = v => follow ? v.map((x, a) => x - middle[3 * row + a]) : v;
  const marker = (f, m) => seen(vector(markerPlace, f * M + m)), origin = s => seen(vector(boneOrigin, row * S + s));
  function axes(s, from) {
    return AXES.map((colour, a) => [from, from.map((x, b) => x + 0.25 * boneRotation[9 * (row * S + s) + 3 * b + a]), colour]);
  }
  function trails() {
    const made = [], from = Math.max(1, row - 60);
    for (let m = 0; m < M; m++) for (let f = from; f <= row; f++) {
      const a = marker(f - 1, m), b = marker(f, m);
      if (known(a) && known(b)) made.push([a, b, [...colourOf(m), 0.15 + 0.5 * (f - from) / 60]]);
    }
    return made;
  }
  scene.draw = (view, lens, ratio) => {
    const places = markers.labels.map((_, m) => marker(row, m)), origins = markers.segments.map((_, s) => origin(s));
    if (shown.trails) drawLines(trails());
    if (shown.lines) drawLines(places.map((p, m) => [origins[markers.owner[m]], p, [...colourOf(m), 0.45]]).filter(([a, b]) => a && known(a) && known(b)));
    if (shown.bones) drawLines(origins.flatMap((o, s) => known(o) ? axes(s, o) : []).filter(([, end]) => known(end)));
    const dots = isFilled => places.map((p, m) => [p, [...colourOf(m), 1], m]).filter(([p, , m]) => known(p) && !!filled[row * M + m] === isFilled);
    if (shown.markers) { drawPoints(dots(false), 9 * ratio); drawPoints(dots(true), 5 * ratio); }
    names(shown.names, origins, view, lens);
    labels(shown.labels, places, view, lens);
  };
  return {
    show(frame) { row = markerRow(frame); later(); },
    follow(on) { follow = on; later(); },
    toggle(what, on) { shown[what] = on; later(); },
  };
}

const markerView = makeMarkers(byId("scene"), byId("scene-problem")), player = makePlayer();
followers.push(fromUser => {
  player.follow(markerWords(current));
  if (markerView) markerView.show(current);
  if (fromUser) player.stop();
});
if (markerView) {
  byId("follow").addEventListener("change", event => markerView.follow(event.target.checked));
  for (const what of ["markers", "bones", "lines", "trails", "names", "labels"]) byId("show-" + what).addEventListener("change", event => markerView.toggle(what, event.target.checked));
  window.addEventListener("resize", () => markerView.show(current));
}
// report.html#frame=120 opens at that frame.
const linked = /frame=(\d+)/.exec(location.hash);
showFrame(linked ? Math.round((Number(linked[1]) - data.first) / data.stride) : 0, false);
