// A knee's bones and cartilages, still or in motion, the tibia held fast or in the room; cartilage in colours of a scale.
"use strict";

const KNEE_VERTEX = `
attribute vec3 place; attribute vec3 normal; attribute float code;
uniform mat4 pose; uniform mat4 view; uniform mat4 lens; uniform vec3 plain; uniform vec3 stops[5]; uniform vec3 overlap; uniform vec3 far;
varying vec3 towards; varying vec3 turned; varying vec3 tint;
void main() {
  vec4 seen = view * pose * vec4(place, 1.0);
  turned = mat3(view) * mat3(pose) * normal; towards = -seen.xyz;
  float c = floor(code * 255.0 + 0.5), at = 4.0 * (255.0 - c) / 253.0;
  vec3 near = mix(stops[0], stops[1], clamp(at, 0.0, 1.0));
  near = mix(near, stops[2], clamp(at - 1.0, 0.0, 1.0)); near = mix(near, stops[3], clamp(at - 2.0, 0.0, 1.0));
  near = mix(near, stops[4], clamp(at - 3.0, 0.0, 1.0));
  tint = plain.r >= 0.0 ? plain : c < 0.5 ? far : c < 1.5 ? overlap : near;
  gl_Position = lens * seen;
}`;
const KNEE_PIXEL = `
precision mediump float; varying vec3 towards; varying vec3 turned; varying vec3 tint; uniform float opacity;
void main() {
  float facing = abs(dot(normalize(turned), normalize(towards)));
  gl_FragColor = vec4(tint * (0.42 + 0.62 * facing), opacity);
}`;

function makeKnee(canvas, problem, knee) {
  const shown = { through: true, paths: true, parts: {}, held: knee.held, motions: [0] }, SIZE = 1 / knee.size;
  const scene = makeScene(canvas, problem, { middle: [0, 0, 0], distance: 4.0, reach: [0.6, 40], lift: 0.1 });
  if (!scene) return null;
  const { gl, eye, buffer, drawLines, drawPoints, later } = scene;
  gl.getExtension("OES_element_index_uint");
  if (shown.held === "room") eye.turn += knee.heading;
  const paint = scene.program(KNEE_VERTEX, KNEE_PIXEL), stops = new Float32Array(knee.stops.flatMap(rgb)), bone = rgb(knee.bone);
  for (const motion of knee.motions) for (const name in motion.poses) motion.poses[name] = floats(motion.poses[name]);
  for (const motion of knee.motions) for (const path of motion.paths) path.places = floats(path.places);
  const parts = knee.parts.map(readPart);
  let frame = 0;

  function readPart(part) {
    const raw = new Uint16Array(bytes(part.places)), count = raw.length / 3, places = new Float32Array(raw.length);
    for (let i = 0; i < raw.length; i++) places[i] = part.low[i % 3] + raw[i] * part.step;
    const faces = part.wide ? new Uint32Array(bytes(part.faces)) : new Uint16Array(bytes(part.faces)), normals = new Float32Array(raw.length);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const u = [0, 1, 2].map(k => places[b + k] - places[a + k]), v = [0, 1, 2].map(k => places[c + k] - places[a + k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      for (const at of [a, b, c]) for (let k = 0; k < 3; k++) normals[at + k] += n[k];
    }
    for (let i = 0; i < normals.length; i += 3) {
      const l = Math.hypot(normals[i], normals[i + 1], normals[i + 2]) || 1;
      for (let k = 0; k < 3; k++) normals[i + k] /= l;
    }
    shown.parts[part.switch] = part.shown;
    const maps = part.maps.map(map => map === null ? null : new Uint8Array(bytes(map)));
    return {
      ...part, count, maps, codes: new Uint8Array(count), sources: part.sources ? new Uint32Array(bytes(part.sources)) : null, length: faces.length,
      kind: part.wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, places: buffer(places), normals: buffer(normals), code: buffer(new Uint8Array(count)), faces: buffer(faces, gl.ELEMENT_ARRAY_BUFFER),
    };
  }
  // Matrices are rows of 12 numbers: three of the rotation and one of the translation [mm] each.
  const times = (a, b) => Float64Array.from({ length: 12 }, (_, i) => {
    const r = 4 * Math.floor(i / 4), c = i % 4;
    return a[r] * b[c] + a[r + 1] * b[4 + c] + a[r + 2] * b[8 + c] + (c === 3 ? a[r + 3] : 0);
  });
  function inverse(a) {
    const made = new Float64Array(12);
    for (let r = 0; r < 3; r++) { for (let c = 0; c < 3; c++) made[4 * r + c] = a[4 * c + r]; made[4 * r + 3] = -(a[r] * a[3] + a[4 + r] * a[7] + a[8 + r] * a[11]); }
    return made;
  }
  // Where a bone is drawn: with the tibia held, tibia from room times room from bone; null where it is unknown.
  function poseOf(motion, name, f) {
    const own = knee.carried[name] || name, all = motion.poses[own];
    if (!all) return null;
    const room = all.subarray(12 * f, 12 * f + 12);
    let pose = room;
    if (shown.held === "tibia") {
      const base = motion.poses.tibia.subarray(12 * f, 12 * f + 12);
      pose = times(inverse(base), room);
    }
    if (pose[0] !== pose[0]) return null;
    const middle = shown.held === "tibia" ? knee.middle : along(motion, f), made = Float64Array.from(pose);
    for (let r = 0; r < 3; r++) made[4 * r + 3] -= middle[r];
    return made;
  }
  // In the room the eye goes along with the knee.
  function along(motion, f) {
    for (const name of ["tibia", "femur"]) {
      const p = motion.poses[name] && motion.poses[name].subarray(12 * f, 12 * f + 12), m = knee.middle;
      if (p && p[0] === p[0]) return [0, 1, 2].map(r => p[4 * r] * m[0] + p[4 * r + 1] * m[1] + p[4 * r + 2] * m[2] + p[4 * r + 3]);
    }
    return [0, 0, 0];
  }
  const at = (m, p) => [0, 1, 2].map(r => SIZE * (m[4 * r] * p[0] + m[4 * r + 1] * p[1] + m[4 * r + 2] * p[2] + m[4 * r + 3]));
  const matrix = m => new Float32Array([0, 1, 2, 3].flatMap(c => [0, 1, 2].map(r => SIZE * m[4 * r + c]).concat(c === 3 ? 1 : 0)));

  function colour(part, number) {
    const map = part.maps[number];
    part.codes.fill(0);
    if (map) for (let i = 0; i < part.sources.length; i++) part.codes[part.sources[i]] = map[frame * part.sources.length + i];
    gl.bindBuffer(gl.ARRAY_BUFFER, part.code); gl.bufferData(gl.ARRAY_BUFFER, part.codes, gl.DYNAMIC_DRAW);
  }
  function drawPart(part, pose, view, lens) {
    gl.useProgram(paint);
    const set = name => gl.getUniformLocation(paint, name), used = [["place", part.places, 3, gl.FLOAT, false], ["normal", part.normals, 3, gl.FLOAT, false], ["code", part.code, 1, gl.UNSIGNED_BYTE, true]];
    for (const [name, held, size, kind, scaled] of used) {
      const where = gl.getAttribLocation(paint, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, held); gl.enableVertexAttribArray(where); gl.vertexAttribPointer(where, size, kind, scaled, 0, 0);
    }
    gl.uniformMatrix4fv(set("pose"), false, matrix(pose)); gl.uniformMatrix4fv(set("view"), false, view); gl.uniformMatrix4fv(set("lens"), false, lens);
    gl.uniform3fv(set("stops"), stops); gl.uniform3fv(set("overlap"), rgb(knee.overlap)); gl.uniform3fv(set("far"), rgb(knee.far));
    gl.uniform3fv(set("plain"), part.cartilage ? [-1, 0, 0] : knee.carried[part.bone] ? [0.6, 0.62, 0.65] : bone);
    gl.uniform1f(set("opacity"), part.cartilage || !shown.through ? 1 : 0.38);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, part.faces);
    if (!part.cartilage && shown.through) {
      gl.colorMask(false, false, false, false); gl.drawElements(gl.TRIANGLES, part.length, part.kind, 0); gl.colorMask(true, true, true, true);
    }
    gl.depthFunc(gl.LEQUAL); gl.drawElements(gl.TRIANGLES, part.length, part.kind, 0); gl.depthFunc(gl.LESS);
    for (const [name] of used) gl.disableVertexAttribArray(gl.getAttribLocation(paint, name));
  }
  function drawPaths(motion, ratio) {
    const lines = [], dots = [];
    for (const path of motion.paths) {
      const own = poseOf(motion, path.bone, frame), place = f => path.places.subarray(3 * f, 3 * f + 3), known = p => p[0] === p[0];
      if (!own || !shown.parts[path.bone]) continue;
      for (let f = 1; f < time.length; f++) {
        const a = place(f - 1), b = place(f);
        if (known(a) && known(b)) lines.push([at(own, a), at(own, b), [0.08, 0.08, 0.1, f <= frame ? 0.95 : 0.25]]);
      }
      if (known(place(frame))) dots.push([at(own, place(frame)), [0.08, 0.08, 0.1, 1]]);
    }
    gl.disable(gl.DEPTH_TEST); drawLines(lines); drawPoints(dots, 9 * ratio); gl.enable(gl.DEPTH_TEST);
  }
  scene.draw = (view, lens, ratio) => {
    const many = shown.motions.length, wide = Math.floor(canvas.width / many);
    shown.motions.forEach((number, i) => {
      const motion = knee.motions[number], own = Float32Array.from(lens);
      own[0] *= many;
      gl.viewport(i * wide, 0, wide, canvas.height);
      scene.see(view, own);
      const drawn = parts.filter(part => shown.parts[part.switch]).map(part => [part, poseOf(motion, part.bone, frame)]).filter(([, pose]) => pose);
      for (const [part, pose] of drawn) if (part.cartilage) { colour(part, number); drawPart(part, pose, view, own); }
      for (const [part, pose] of drawn) if (!part.cartilage) drawPart(part, pose, view, own);
      if (shown.paths) drawPaths(motion, ratio);
    });
    tags.forEach((tag, i) => { tag.hidden = many < 2; tag.style.left = `${50 * i + 1}%`; });
  };
  const layer = document.createElement("div");
  layer.className = "names"; canvas.parentElement.appendChild(layer);
  const tags = knee.motions.map(motion => { const tag = document.createElement("span"); tag.style.top = "8px"; tag.textContent = motion.label; layer.appendChild(tag); return tag; });
  return {
    shown, later,
    show(next) { frame = next; later(); },
    hold(what) { if (what !== shown.held) eye.turn += what === "room" ? knee.heading : -knee.heading; shown.held = what; },
    look(turn, lift, distance) { eye.turn = turn + (shown.held === "room" ? knee.heading : 0); eye.lift = lift; eye.distance = distance; later(); },
    answered: f => shown.motions.some(n => poseOf(knee.motions[n], "femur", f) || (shown.held === "room" && poseOf(knee.motions[n], "tibia", f))),
  };
}

const knee = makeKnee(byId("scene"), byId("scene-problem"), data.knee);
function showScale({ ends, colours, apart }) {
  const block = (width, paint) => {
    const made = document.createElement("i");
    made.style.cssText = `display:inline-block;width:${width}px;height:11px;vertical-align:-1px;margin:0 6px;background:${paint}`;
    return made;
  };
  if (apart) byId("scale").append(apart[0], block(11, apart[1]));
  byId("scale").append(ends[0], block(150, `linear-gradient(90deg,${colours.join(",")})`), ends[1]);
}
if (knee) {
  const { shown, later } = knee, lateral = data.knee.left ? 1 : -1;
  if (data.knee.scale) showScale(data.knee.scale);
  // The eye of turn 0 stands in front (y of LPS points back). If the side of the knee is unknown, the patient's side is named.
  const [inner, outer] = data.knee.left === null ? ["left", "right"] : ["medial", "lateral"];
  const sides = { anterior: [0, 0, 4], [inner]: [-lateral * Math.PI / 2, 0, 4], [outer]: [lateral * Math.PI / 2, 0, 4], posterior: [Math.PI, 0, 4], plateau: [Math.PI, 1.5, 2.6] };
  function lookFrom(name) {
    for (const part of data.knee.parts) if (part.bone !== "tibia") tick(part.switch, name !== "plateau" && !data.knee.carried[part.bone]);
    knee.look(...sides[name]);
  }
  for (const name in sides) {
    const button = document.createElement("button");
    button.type = "button"; button.textContent = name;
    button.addEventListener("click", () => lookFrom(name));
    byId("sides").appendChild(button);
  }
  const boxes = {};
  function tick(name, on) { if (boxes[name]) { boxes[name].checked = on; shown.parts[name] = on; later(); } }
  for (const name of Object.keys(shown.parts)) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox"; box.checked = shown.parts[name]; boxes[name] = box;
    box.addEventListener("change", () => tick(name, box.checked));
    label.append(box, ` ${name.replace("_", " ")}${data.knee.carried[name] ? " (not measured: drawn with the femur)" : ""}`);
    byId("parts").appendChild(label);
  }
  shown.through = byId("show-through").checked;
  byId("show-through").addEventListener("change", event => { shown.through = event.target.checked; later(); });
  window.addEventListener("resize", later);
  // knee.html#frame=120&side=medial opens there.
  const side = /side=(\w+)/.exec(location.hash);
  if (side && sides[side[1]]) lookFrom(side[1]);
  later();
}
