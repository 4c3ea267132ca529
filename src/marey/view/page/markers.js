// Skin markers and the frames of the bones beneath them, over time.
"use strict";

// What a frame has, in words; also without the view.
const markers = data.markers, markerPlace = floats(markers.place), boneRotation = floats(markers.rotation);
function markerWords(frame) {
  const f = Math.floor(frame / markers.every), M = markers.labels.length, S = markers.segments.length;
  const count = (array, total, width) => Array.from({ length: total }, (_, k) => array[width * (f * total + k)]).filter(v => v === v).length;
  return `${count(markerPlace, M, 3)} of ${M} markers, ${count(boneRotation, S, 9)} of ${S} bones`;
}

const markerView = makeMarkers(byId("scene"), byId("scene-problem"), markers), player = makePlayer();
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
