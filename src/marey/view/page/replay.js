// The captured body in three dimensions: the page blends the skin itself, in the graphics card.
"use strict";

const SKIN_VERTEX = (segments) => `${ON_SCREEN}
attribute vec3 rest; attribute vec3 normal; attribute vec4 carrier; attribute vec4 weight; attribute vec3 colour;
uniform vec4 rows[${3 * segments}]; uniform mat4 view;
varying vec3 towards; varying vec3 turned; varying vec3 tint;
void main() {
  vec4 r0 = vec4(0.0), r1 = vec4(0.0), r2 = vec4(0.0);
  for (int n = 0; n < 4; n++) {
    int k = int(carrier[n] + 0.5) * 3;
    r0 += weight[n] * rows[k]; r1 += weight[n] * rows[k + 1]; r2 += weight[n] * rows[k + 2];
  }
  vec4 p = vec4(rest, 1.0);
  vec4 seen = view * vec4(dot(r0, p), dot(r1, p), dot(r2, p), 1.0);
  turned = mat3(view) * vec3(dot(r0.xyz, normal), dot(r1.xyz, normal), dot(r2.xyz, normal));
  towards = -seen.xyz; tint = colour;
  gl_Position = onScreen(seen);
}`;
const SKIN_PIXEL = `
precision mediump float; varying vec3 towards; varying vec3 turned; varying vec3 tint; uniform float opacity;
void main() {
  float facing = clamp(dot(normalize(turned), normalize(towards)), 0.0, 1.0);
  float above = 0.5 + 0.5 * normalize(turned).y;
  gl_FragColor = vec4(tint * (0.38 + 0.5 * facing + 0.22 * above), opacity);
}`;

// One body in a scene: the arrays of its motion may be filled later, and contain NaN until then.
function makeBody(scene, { replay: body, joints, trail }, tint) {
  const { gl, drawLines, drawPoints } = scene, S = body.segments, J = joints.names.length;
  const rotation = floats(body.rotation), origin = floats(body.origin), centres = floats(joints.centres), frames = centres.length / (3 * J || 1);
  const colours = joints.colours.map(colour => rgb(tint || colour));
  const skin = body.rest ? makeSkin(scene, body, tint) : null;

  function segmentRows(frame) {
    const rows = new Float32Array(12 * S), restJoints = skin.restJoints;
    for (let k = 0; k < S; k++) for (let a = 0; a < 3; a++) {
      let shift = origin[3 * (frame * S + k) + a];
      for (let b = 0; b < 3; b++) {
        const r = rotation[9 * (frame * S + k) + 3 * a + b];
        rows[12 * k + 4 * a + b] = r; shift -= r * restJoints[3 * k + b];
      }
      rows[12 * k + 4 * a + 3] = shift;
    }
    return rows;
  }
  const joint = (f, j) => [0, 1, 2].map(a => centres[3 * (f * J + j) + a]);
  const known = v => v[0] === v[0];
  function trails(frame) {
    const made = [], from = trail ? Math.max(1, frame - trail) : 1, end = trail ? Math.min(frames, frame + trail) : frames;
    for (let j = 0; j < J; j++) for (let f = from; f < end; f++) {
      const a = joint(f - 1, j), b = joint(f, j);
      if (known(a) && known(b)) made.push([a, b, [...colours[j], 0.6]]);
    }
    return made;
  }
  return (frame, shown, view, lens, ratio) => {
    if (shown.trails) drawLines(trails(frame));
    if (shown.surface && skin && origin[3 * frame * S] === origin[3 * frame * S]) skin.draw(view, lens, segmentRows(frame), scene.eye.camera >= 0 && shown.image ? 0.45 : shown.bones ? 0.78 : 1);
    if (shown.bones) {
      const places = joints.names.map((_, j) => joint(frame, j)), dark = tint ? [...rgb(tint), 0.9] : [0.12, 0.14, 0.17, 0.9];
      gl.disable(gl.DEPTH_TEST);
      drawLines(joints.bones.map(([a, b]) => [places[a], places[b], dark]).filter(([a, b]) => known(a) && known(b)));
      drawPoints(places.map((p, j) => [p, [...colours[j], 1]]).filter(([p]) => known(p)), 9 * ratio);
      gl.enable(gl.DEPTH_TEST);
    }
  };
}

function makeSkin({ gl, buffer, program, bend }, body, tint) {
  const skin = program(SKIN_VERTEX(body.segments), SKIN_PIXEL);
  const owner = new Uint8Array(bytes(body.owner)), colours = body.colours.map(colour => rgb(tint || colour)), tints = new Float32Array(3 * owner.length);
  owner.forEach((k, v) => tints.set(colours[k], 3 * v));
  const faces = new Uint32Array(bytes(body.faces));
  const buffers = {
    rest: buffer(floats(body.rest)), normal: buffer(new Int8Array(bytes(body.normals))), colour: buffer(tints),
    carrier: buffer(new Uint8Array(bytes(body.vertexSegments))), weight: buffer(new Uint8Array(bytes(body.vertexWeights))),
    faces: buffer(faces, gl.ELEMENT_ARRAY_BUFFER),
  };
  const used = [["rest", 3, gl.FLOAT, false], ["normal", 3, gl.BYTE, true], ["carrier", 4, gl.UNSIGNED_BYTE, false], ["weight", 4, gl.UNSIGNED_BYTE, true], ["colour", 3, gl.FLOAT, false]];
  function draw(view, lens, rows, opacity) {
    gl.useProgram(skin);
    for (const [name, size, kind, scaled] of used) {
      const at = gl.getAttribLocation(skin, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]); gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, size, kind, scaled, 0, 0);
    }
    const set = name => gl.getUniformLocation(skin, name);
    gl.uniform4fv(set("rows"), rows); gl.uniformMatrix4fv(set("view"), false, view); gl.uniformMatrix4fv(set("lens"), false, lens); bend(skin);
    gl.uniform1f(set("opacity"), opacity);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.faces);
    // First the depth alone, so that a transparent body shows its outside only.
    gl.enable(gl.CULL_FACE); gl.colorMask(false, false, false, false);
    gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
    gl.colorMask(true, true, true, true); gl.depthFunc(gl.LEQUAL);
    gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
    gl.depthFunc(gl.LESS); gl.disable(gl.CULL_FACE);
    for (const [name] of used) gl.disableVertexAttribArray(gl.getAttribLocation(skin, name));
  }
  return { draw, restJoints: floats(body.restJoints) };
}

function centreOf(points, count) {
  const sums = [0, 0, 0]; let n = 0;
  for (let i = 0; i < points.length; i += 3 * count) if (points[i] === points[i]) { n++; for (let a = 0; a < 3; a++) sums[a] += points[i + a]; }
  return n ? sums.map(s => s / n) : [0, 0, 1];
}
function lowest(points) {
  let low = Infinity;
  for (let i = 2; i < points.length; i += 3) if (points[i] < low) low = points[i];
  return Math.abs(low) < 0.25 || low === Infinity ? 0 : low;
}
// Lines in pieces, so that the lens of a camera bends them.
function floorLines(middle, floor) {
  const made = [], half = 3, x = Math.round(middle[0]), y = Math.round(middle[1]), step = 0.5;
  for (let i = -2 * half; i <= 2 * half; i++) {
    const shade = [0.55, 0.6, 0.66, i % 2 ? 0.25 : 0.5];
    for (let a = -half; a < half; a += step) made.push([[x + i / 2, y + a, floor], [x + i / 2, y + a + step, floor], shade], [[x + a, y + i / 2, floor], [x + a + step, y + i / 2, floor], shade]);
  }
  return made;
}
// A pyramid for each camera: its centre, and the picture's corners held at a little distance.
function cameraLines(cameras) {
  const made = [];
  for (const camera of cameras) {
    const world = (x, y, z) => [0, 1, 2].map(a => [0, 1, 2].reduce((s, b) => s + camera.rotation[b][a] * ([x, y, z][b] - camera.translation[b]), 0));
    const m = camera.matrix, depth = 0.35, tip = world(0, 0, 0);
    const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => world((u * camera.size[0] - m[0][2]) / m[0][0] * depth, (v * camera.size[1] - m[1][2]) / m[1][1] * depth, depth));
    corners.forEach((corner, i) => made.push([tip, corner, [0.18, 0.36, 0.54, 0.8]], [corner, corners[(i + 1) % 4], [0.18, 0.36, 0.54, 0.8]]));
  }
  return made;
}

// Further bodies are shown in one colour. `data.middle` and `data.floor` are given where the motion is filled in later.
function makeReplay(canvas, problem, data, others = [], colour = "#d9a520") {
  const shown = { surface: true, bones: true, trails: false, floor: true, others: true }, cameras = data.replay.cameras;
  const middle = data.middle || centreOf(floats(data.replay.origin), data.replay.segments);
  const scene = makeScene(canvas, problem, { middle, distance: 4.2, cameras });
  if (!scene) return null;
  const { eye, drawLines, later } = scene, bodies = [makeBody(scene, data)], further = others.map(other => makeBody(scene, other, colour));
  const grid = floorLines(middle, data.floor === undefined ? lowest(floats(data.joints.centres)) : data.floor), rigs = cameraLines(cameras);
  let frames = [0];
  scene.draw = (view, lens, ratio) => {
    if (shown.floor) drawLines(grid);
    if (eye.camera < 0) drawLines(rigs);
    (shown.others ? [...bodies, ...further] : bodies).forEach((draw, i) => { if (frames[i] >= 0) draw(frames[i], shown, view, lens, ratio); });
  };
  return {
    scene, shown,
    show(...next) { frames = next; later(); },
    lookFrom: scene.lookFrom,
    toggle(what, on) { shown[what] = on; later(); },
  };
}
