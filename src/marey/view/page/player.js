// The clock of a replay: play and pause, speed, the slider, and the keys space, arrows, Home and End. The page's showFrame shows a frame.
"use strict";

function makePlayer() {
  let playing = false, startedAt = 0, startedFrom = 0;
  function stop() { playing = false; byId("play").textContent = "Play"; }
  function play() {
    playing = true; byId("play").textContent = "Pause";
    startedAt = performance.now(); startedFrom = current >= time.length - 1 ? 0 : current;
    requestAnimationFrame(tick);
  }
  function tick(now) {
    if (!playing) return;
    const passed = (now - startedAt) / 1000 * Number(byId("speed").value) * data.rate / data.stride;
    showFrame((startedFrom + Math.max(0, Math.floor(passed))) % time.length, false);
    requestAnimationFrame(tick);
  }
  byId("play").addEventListener("click", () => playing ? stop() : play());
  byId("speed").addEventListener("change", () => { if (playing) play(); });
  byId("slider").max = time.length - 1;
  byId("slider").addEventListener("input", event => showFrame(Number(event.target.value), true));
  const steps = { ArrowRight: 1, ArrowLeft: -1, Home: -Infinity, End: Infinity };
  document.addEventListener("keydown", event => {
    const { tagName, type } = event.target;
    if (event.ctrlKey || event.metaKey || event.altKey || tagName === "SELECT") return;
    if (event.key === " " && tagName !== "BUTTON" && type !== "checkbox") { playing ? stop() : play(); event.preventDefault(); }
    if (event.key in steps && type !== "range") { showFrame(current + (event.shiftKey ? 10 : 1) * steps[event.key], true); event.preventDefault(); }
  });
  return {
    stop, play,
    get playing() { return playing; },
    follow(words) {
      byId("slider").value = current;
      byId("clock").textContent = `frame ${(data.first || 0) + current * data.stride} · ${time[current].toFixed(2)} s${words ? ` · ${words}` : ""}`;
    },
  };
}
