// A knee's replay: the clock, what is held, which skin correction is seen, and the centres' paths.
"use strict";

const player = makePlayer();
followers.push(fromUser => {
  player.follow(!knee || knee.answered(current) ? "" : "no result");
  if (knee) knee.show(current);
  if (fromUser) player.stop();
});
if (knee) {
  const { shown, later } = knee, motions = data.knee.motions;
  motions.forEach((motion, n) => byId("motion").add(new Option(motion.label, n)));
  if (motions.length > 1) { byId("motion").add(new Option("side by side", "all")); byId("motion").value = "all"; shown.motions = motions.map((_, n) => n); }
  else byId("choose-motion").style.display = "none";
  byId("motion").addEventListener("change", event => { shown.motions = event.target.value === "all" ? motions.map((_, n) => n) : [Number(event.target.value)]; showFrame(current, false); });
  byId("held").value = shown.held;
  if (!data.knee.room) byId("held").parentElement.style.display = "none";
  byId("held").addEventListener("change", event => { knee.hold(event.target.value); showFrame(current, false); });
  byId("show-paths").addEventListener("change", event => { shown.paths = event.target.checked; later(); });
}
const linked = /frame=(\d+)/.exec(location.hash);
showFrame(linked ? Math.round(Number(linked[1]) / data.stride) : data.knee.first, false);
