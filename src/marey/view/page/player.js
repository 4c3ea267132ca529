// The clock of a replay: play and pause, speed, the slider, and the arrow keys. The page's showFrame shows a frame.
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
  document.addEventListener("keydown", event => {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName)) return;
    if (event.key === "ArrowRight" || event.key === "ArrowLeft") { showFrame(current + (event.key === "ArrowRight" ? 1 : -1), true); event.preventDefault(); }
  });
  return {
    stop,
    follow(words) {
      byId("slider").value = current;
      byId("clock").textContent = `frame ${(data.first || 0) + current * data.stride} · ${time[current].toFixed(2)} s${words ? ` · ${words}` : ""}`;
    },
  };
}
