// The captured body in three dimensions: the page blends the skin itself, in the graphics card.
"use strict";

const SKIN_VERTEX = (segments) => `
attribute vec3 rest; attribute vec3 normal; attribute vec4 carrier; attribute vec4 weight; attribute vec3 colour;
uniform vec4 rows[${3 * segments}]; uniform mat4 view; uniform mat4 lens;
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
  gl_Position = lens * seen;
}`;
const SKIN_PIXEL = `
precision mediump float; varying vec3 towards; varying vec3 turned; varying vec3 tint; uniform float opacity;
void main() {
  float facing = clamp(dot(normalize(turned), normalize(towards)), 0.0, 1.0);
  float above = 0.5 + 0.5 * normalize(turned).y;
  gl_FragColor = vec4(tint * (0.38 + 0.5 * facing + 0.22 * above), opacity);
}`;

function makeReplay(canvas, problem, data) {
  const body = data.replay, S = body.segments, J = data.joints.names.length;
  const rotation = floats(body.rotation), origin = floats(body.origin), restJoints = floats(body.restJoints);
  const centres = floats(data.joints.centres), bones = data.joints.bones;
  const shown = { surface: true, bones: true, trails: false };
  const middle = centreOf(origin, S), floor = lowest(centres);
  const scene = makeScene(canvas, problem, { middle, distance: 4.2, cameras: body.cameras });
  if (!scene) return null;
  const { gl, eye, buffer, drawLines, drawPoints, later } = scene;

  const skin = scene.program(SKIN_VERTEX(S), SKIN_PIXEL);
  const owner = new Uint8Array(bytes(body.owner)), colours = body.colours.map(rgb), tints = new Float32Array(3 * owner.length);
  owner.forEach((k, v) => tints.set(colours[k], 3 * v));
  const faces = new Uint32Array(bytes(body.faces));
  const buffers = {
    rest: buffer(floats(body.rest)), normal: buffer(new Int8Array(bytes(body.normals))), colour: buffer(tints),
    carrier: buffer(new Uint8Array(bytes(body.vertexSegments))), weight: buffer(new Uint8Array(bytes(body.vertexWeights))),
    faces: buffer(faces, gl.ELEMENT_ARRAY_BUFFER),
  };
  const grid = floorLines(), rigs = cameraLines();
  let frame = 0;

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
  function floorLines() {
    const made = [], half = 3, x = Math.round(middle[0]), y = Math.round(middle[1]);
    for (let i = -2 * half; i <= 2 * half; i++) {
      const shade = [0.55, 0.6, 0.66, i % 2 ? 0.25 : 0.5];
      made.push([[x + i / 2, y - half, floor], [x + i / 2, y + half, floor], shade], [[x - half, y + i / 2, floor], [x + half, y + i / 2, floor], shade]);
    }
    return made;
  }
  // A pyramid for each camera: its centre, and the picture's corners held at a little distance.
  function cameraLines() {
    const made = [];
    for (const camera of body.cameras) {
      const world = (x, y, z) => [0, 1, 2].map(a => [0, 1, 2].reduce((s, b) => s + camera.rotation[b][a] * ([x, y, z][b] - camera.translation[b]), 0));
      const m = camera.matrix, depth = 0.35, tip = world(0, 0, 0);
      const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => world((u * camera.size[0] - m[0][2]) / m[0][0] * depth, (v * camera.size[1] - m[1][2]) / m[1][1] * depth, depth));
      corners.forEach((corner, i) => made.push([tip, corner, [0.18, 0.36, 0.54, 0.8]], [corner, corners[(i + 1) % 4], [0.18, 0.36, 0.54, 0.8]]));
    }
    return made;
  }

  function segmentRows() {
    const rows = new Float32Array(12 * S);
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
  function drawSkin(view, lens, rows) {
    gl.useProgram(skin);
    const used = [["rest", 3, gl.FLOAT, false], ["normal", 3, gl.BYTE, true], ["carrier", 4, gl.UNSIGNED_BYTE, false], ["weight", 4, gl.UNSIGNED_BYTE, true], ["colour", 3, gl.FLOAT, false]];
    for (const [name, size, kind, scaled] of used) {
      const at = gl.getAttribLocation(skin, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]); gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, size, kind, scaled, 0, 0);
    }
    const set = name => gl.getUniformLocation(skin, name);
    gl.uniform4fv(set("rows"), rows); gl.uniformMatrix4fv(set("view"), false, view); gl.uniformMatrix4fv(set("lens"), false, lens);
    gl.uniform1f(set("opacity"), shown.bones ? 0.78 : 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.faces);
    // First the depth alone, so that a transparent body shows its outside only.
    gl.enable(gl.CULL_FACE); gl.colorMask(false, false, false, false);
    gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
    gl.colorMask(true, true, true, true); gl.depthFunc(gl.LEQUAL);
    gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
    gl.depthFunc(gl.LESS); gl.disable(gl.CULL_FACE);
    for (const [name] of used) gl.disableVertexAttribArray(gl.getAttribLocation(skin, name));
  }
  const joint = (f, j) => [0, 1, 2].map(a => centres[3 * (f * J + j) + a]);
  function trails() {
    const made = [];
    for (let j = 0; j < J; j++) {
      const colour = [...rgb(data.joints.colours[j]), 0.6];
      for (let f = 1; f < time.length; f++) {
        const a = joint(f - 1, j), b = joint(f, j);
        if (a[0] === a[0] && b[0] === b[0]) made.push([a, b, colour]);
      }
    }
    return made;
  }

  scene.draw = (view, lens, ratio) => {
    drawLines(grid);
    if (eye.camera < 0) drawLines(rigs);
    if (shown.trails) drawLines(trails());
    const rows = segmentRows();
    if (rows[0] !== rows[0]) return;
    if (shown.surface) drawSkin(view, lens, rows);
    if (shown.bones) {
      gl.disable(gl.DEPTH_TEST);
      drawLines(bones.map(([a, b]) => [joint(frame, a), joint(frame, b), [0.12, 0.14, 0.17, 0.9]]));
      drawPoints(data.joints.names.map((_, j) => [joint(frame, j), [...rgb(data.joints.colours[j]), 1]]), 9 * ratio);
      gl.enable(gl.DEPTH_TEST);
    }
  };
  return {
    show(next) { frame = next; later(); },
    lookFrom: scene.lookFrom,
    toggle(what, on) { shown[what] = on; later(); },
  };
}
