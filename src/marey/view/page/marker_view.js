// Skin markers and the frames of the bones beneath them, in three dimensions.
"use strict";

const known = v => v[0] === v[0];
const vector = (array, at) => [array[3 * at], array[3 * at + 1], array[3 * at + 2]];

function makeMarkers(canvas, problem, markers) {
  const M = markers.labels.length, S = markers.segments.length, markerRow = frame => Math.floor(frame / markers.every);
  const markerPlace = floats(markers.place), boneOrigin = floats(markers.origin), boneRotation = floats(markers.rotation);
  for (const each of markers.forces || []) for (const name of ["corners", "at", "force"]) each[name] = floats(each[name]);
  const filled = new Uint8Array(bytes(markers.filled)), middle = floats(markers.middle);
  const shown = { markers: true, bones: true, lines: true, trails: false, forces: true, names: false, labels: false };
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
  // Each plate is a rectangle, its force an arrow from the centre of pressure.
  function forces() {
    const made = [], plate = [0.35, 0.38, 0.42, 0.8], red = [0.75, 0.1, 0.1, 1];
    for (const each of markers.forces || []) {
      const corners = [0, 1, 2, 3].map(i => seen(vector(each.corners, i))), at = seen(vector(each.at, row)), force = vector(each.force, row);
      corners.forEach((corner, i) => made.push([corner, corners[(i + 1) % 4], plate]));
      if (!known(at)) continue;
      const end = at.map((x, a) => x + force[a]), side = [force[2] * 0.04, 0, 0], back = (share, sign) => at.map((x, a) => x + share * force[a] + sign * side[a]);
      made.push([at, end, red], [back(0, 0.2), back(0.9, 0.2), red], [back(0, -0.2), back(0.9, -0.2), red], [end, back(0.88, 1), red], [end, back(0.88, -1), red]);
    }
    return made;
  }
  scene.draw = (view, lens, ratio) => {
    if (row < 0) return;
    if (shown.forces) drawLines(forces());
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
    scene,
    show(frame) { row = markerRow(frame); later(); },
    follow(on) { follow = on; later(); },
    toggle(what, on) { shown[what] = on; later(); },
  };
}
