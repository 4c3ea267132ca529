// The measured points of a surface, frame by frame, in the colours of the images.
"use strict";

const surface = data.surface;
const pointCounts = surface.places.map(text => new Uint16Array(bytes(text)).length / 3);
// Which of the contained frames is nearest to a frame of the page.
function nearestPart(frame) {
  const away = surface.frames.map(f => Math.abs(f - frame * data.stride));
  return away.indexOf(Math.min(...away));
}
function pointWords(frame) {
  const k = nearestPart(frame), own = surface.frames[k] === frame * data.stride ? "" : `of frame ${data.first + surface.frames[k]}: `;
  return `${own}${pointCounts[k]} of ${surface.of[k]} points shown`;
}

function makeSurface(canvas, problem) {
  const scene = makeScene(canvas, problem, { middle: [0, 0, 0], distance: 3.6, reach: [0.2, 40], lift: 0.1 });
  if (!scene) return null;
  const { gl, eye, buffer, program, later } = scene, paint = program(LINE_VERTEX, LINE_PIXEL), made = {};
  let part = 0, size = 2.5;
  // The first view is from a little beside the camera.
  eye.turn = 0.3;

  function buffers(k) {
    if (!made[k]) {
      const raw = new Uint16Array(bytes(surface.places[k]));
      made[k] = { place: buffer(Float32Array.from(raw, (v, i) => surface.low[i % 3] + v * surface.step)), colour: buffer(new Uint8Array(bytes(surface.colours[k]))) };
    }
    return made[k];
  }
  scene.draw = (view, lens, ratio) => {
    const own = buffers(part), set = name => gl.getUniformLocation(paint, name);
    gl.useProgram(paint);
    for (const [name, kind, scaled] of [["place", gl.FLOAT, false], ["colour", gl.UNSIGNED_BYTE, true]]) {
      const at = gl.getAttribLocation(paint, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, own[name]); gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, 3, kind, scaled, 0, 0);
    }
    gl.uniformMatrix4fv(set("view"), false, view); gl.uniformMatrix4fv(set("lens"), false, lens);
    gl.uniform1f(set("size"), size * ratio); gl.uniform1f(set("round"), 0);
    gl.drawArrays(gl.POINTS, 0, pointCounts[part]);
    for (const name of ["place", "colour"]) gl.disableVertexAttribArray(gl.getAttribLocation(paint, name));
  };
  return {
    show(frame) { part = nearestPart(frame); later(); },
    sized(next) { size = next; later(); },
    goRound: scene.turn,
  };
}

const surfaceView = makeSurface(byId("scene"), byId("scene-problem")), surfacePlayer = byId("play") ? makePlayer() : null;
followers.push(fromUser => {
  if (surfaceView) surfaceView.show(current);
  if (surfacePlayer) { surfacePlayer.follow(pointWords(current)); if (fromUser) surfacePlayer.stop(); }
});
if (surfaceView) {
  byId("point-size").addEventListener("change", event => surfaceView.sized(Number(event.target.value)));
  byId("go-round").addEventListener("change", event => surfaceView.goRound(event.target.checked));
  window.addEventListener("resize", () => surfaceView.show(current));
}
// surface.html#frame=120 opens at that frame; otherwise the page begins with the first one that has points.
const linked = /frame=(\d+)/.exec(location.hash);
showFrame(Math.round((linked ? Number(linked[1]) - data.first : surface.frames[0]) / data.stride), false);
