// A scene that turns: lines and points drawn in the graphics card, the eye that goes round them, the pointer that moves it.
"use strict";

const byId = id => document.getElementById(id);

// Where a point in the axes of the eye is on the screen, through the lens of a camera where `bent` is 1 (radial and
// tangential) or 2 (fisheye); the formulas are those of lens.py, and what has no image is not bent.
const ON_SCREEN = `
uniform mat4 lens; uniform float bent; uniform float k[14]; uniform float limit;
vec4 onScreen(vec4 seen) {
  float depth = -seen.z;
  if (bent < 0.5 || depth <= 0.0) return lens * seen;
  float x = seen.x / depth, y = -seen.y / depth, s = x * x + y * y, u, v;
  if (s > limit) return lens * seen;
  if (bent > 1.5) {
    float r = sqrt(s), angle = atan(r), t = angle * angle;
    float scale = r < 1e-4 ? 1.0 : angle * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))) / r;
    u = scale * x; v = scale * y;
  } else {
    float radial = (1.0 + s * (k[0] + s * (k[1] + s * k[4]))) / (1.0 + s * (k[5] + s * (k[6] + s * k[7])));
    u = x * radial + 2.0 * k[2] * x * y + k[3] * (s + 2.0 * x * x) + s * (k[8] + s * k[9]);
    v = y * radial + k[2] * (s + 2.0 * y * y) + 2.0 * k[3] * x * y + s * (k[10] + s * k[11]);
  }
  return lens * vec4(u * depth, -v * depth, seen.z, 1.0);
}`;
const LINE_VERTEX = `${ON_SCREEN}
attribute vec3 place; attribute vec4 colour; uniform mat4 view; uniform float size; varying vec4 tint;
void main() { tint = colour; gl_Position = onScreen(view * vec4(place, 1.0)); gl_PointSize = size; }`;
const LINE_PIXEL = `
precision mediump float; varying vec4 tint; uniform float round;
void main() {
  float r = length(gl_PointCoord - 0.5);
  if (round > 0.5 && r > 0.5) discard;
  gl_FragColor = round > 0.5 && r > 0.34 ? vec4(1.0, 1.0, 1.0, 1.0) : tint;
}`;

// Whether WebGL is computed by the processor, which takes several times as long for smooth edges. The first WebGL of a
// browser takes up to a second: the pages that load data ask for it when their requests are under way.
let software = null;
function inSoftware() {
  if (software !== null) return software;
  const gl = document.createElement("canvas").getContext("webgl"), named = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl ? gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : "software";
  if (gl && gl.getExtension("WEBGL_lose_context")) gl.getExtension("WEBGL_lose_context").loseContext();
  return software = /swiftshader|llvmpipe|software/i.test(name);
}

// Without WebGL the page states what is missing, and hides what would move the view or choose its content.
function leaveOut(canvas, problem) {
  canvas.hidden = true; canvas.style.display = "none"; problem.hidden = false;
  const section = problem.closest("section");
  for (const part of section.querySelectorAll(".hint, .controls > label, .controls > #sides")) if (!part.querySelector("#speed")) part.style.display = "none";
}

// `middle` is what the eye looks at, from `distance`; `reach` how near and far it may go; `cameras` from which it may look.
function makeScene(canvas, problem, { middle, distance, reach = [0.8, 20], cameras = [], lift = 0.16 }) {
  const gl = canvas.getContext("webgl", { antialias: !inSoftware(), alpha: true });
  if (!gl) { leaveOut(canvas, problem); return null; }
  gl.getExtension("OES_element_index_uint");
  const eye = { turn: -0.7, lift, distance, target: middle.slice(), camera: -1 };
  const lines = program(LINE_VERTEX, LINE_PIXEL), places = gl.createBuffer();
  const scene = { gl, eye, program, buffer, drawLines, drawPoints, later, turn, bend, draw() {}, looked() {}, see(v, l) { view = v; lens = l; } };
  // What part of a camera's image is seen: enlarged by `scale`, and moved by parts of the canvas.
  const part = scene.part = { scale: 1, x: 0, y: 0 };
  let view, lens;

  function program(vertex, pixel) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, pixel]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return made;
  }
  function buffer(array, kind = gl.ARRAY_BUFFER) {
    const made = gl.createBuffer();
    gl.bindBuffer(kind, made); gl.bufferData(kind, array, gl.STATIC_DRAW);
    return made;
  }
  // View and projection: round the middle, or as one of the cameras stands (x right, y down, z ahead become x, -y, -z).
  function looks() {
    const wide = canvas.width / canvas.height, near = 0.05, far = 60;
    if (eye.camera >= 0) {
      const c = cameras[eye.camera], R = c.rotation, t = c.translation, flip = [1, -1, -1], view = new Float32Array(16);
      for (let r = 0; r < 3; r++) { for (let k = 0; k < 3; k++) view[4 * k + r] = flip[r] * R[r][k]; view[12 + r] = flip[r] * t[r]; }
      view[15] = 1;
      const [w, h] = c.size, fit = Math.min(canvas.width / w, canvas.height / h), m = c.matrix;
      const sx = fit * w / canvas.width, sy = fit * h / canvas.height;
      const p = part.scale;
      return [view, new Float32Array([2 * m[0][0] / w * sx * p, 0, 0, 0, -2 * m[0][1] / w * sx * p, 2 * m[1][1] / h * sy * p, 0, 0,
        (1 - 2 * (m[0][2] + 0.5) / w) * sx * p - part.x, (2 * (m[1][2] + 0.5) / h - 1) * sy * p - part.y, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0])];
    }
    const ct = Math.cos(eye.turn), st = Math.sin(eye.turn), cl = Math.cos(eye.lift), sl = Math.sin(eye.lift);
    const right = [ct, st, 0], back = [st * cl, -ct * cl, sl], up = [-st * sl, ct * sl, cl], view = new Float32Array(16);
    [right, up, back].forEach((axis, r) => { for (let k = 0; k < 3; k++) view[4 * k + r] = axis[k]; view[12 + r] = -axis.reduce((s, a, k) => s + a * eye.target[k], 0); });
    view[14] -= eye.distance; view[15] = 1;
    const f = 1 / Math.tan(0.32);
    return [view, new Float32Array([f / wide, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0])];
  }
  // The lens of the camera from which the eye looks, for a program whose vertices use `onScreen`.
  function bend(used) {
    const set = name => gl.getUniformLocation(used, name), own = eye.camera >= 0 && cameras[eye.camera].lens;
    gl.uniform1f(set("bent"), own ? own.model + 1 : 0);
    if (own) { gl.uniform1fv(set("k"), own.coefficients); gl.uniform1f(set("limit"), own.limit === null ? 1e9 : own.limit); }
  }
  function draw(list, mode, size) {
    if (!list.length) return;
    const per = mode === gl.POINTS ? 1 : 2, packed = new Float32Array(7 * per * list.length);
    list.forEach((item, i) => { for (let e = 0; e < per; e++) { packed.set(item[e], 7 * (per * i + e)); packed.set(item[per], 7 * (per * i + e) + 3); } });
    gl.useProgram(lines); gl.bindBuffer(gl.ARRAY_BUFFER, places); gl.bufferData(gl.ARRAY_BUFFER, packed, gl.DYNAMIC_DRAW);
    const at = name => gl.getAttribLocation(lines, name), set = name => gl.getUniformLocation(lines, name);
    gl.enableVertexAttribArray(at("place")); gl.vertexAttribPointer(at("place"), 3, gl.FLOAT, false, 28, 0);
    gl.enableVertexAttribArray(at("colour")); gl.vertexAttribPointer(at("colour"), 4, gl.FLOAT, false, 28, 12);
    gl.uniformMatrix4fv(set("view"), false, view); gl.uniformMatrix4fv(set("lens"), false, lens);
    gl.uniform1f(set("size"), size); gl.uniform1f(set("round"), mode === gl.POINTS ? 1 : 0); bend(lines);
    gl.drawArrays(mode, 0, per * list.length);
    for (const name of ["place", "colour"]) gl.disableVertexAttribArray(at(name));
  }
  // Each line is two places and a colour with its opacity, each point a place and a colour.
  function drawLines(list) { draw(list, gl.LINES, 1); }
  function drawPoints(list, size) { draw(list, gl.POINTS, size); }

  function render() {
    const ratio = window.devicePixelRatio || 1, w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h); gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.enable(gl.BLEND); gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    [view, lens] = looks();
    scene.draw(view, lens, ratio);
  }
  let requested = false;
  function later() { if (!requested) { requested = true; requestAnimationFrame(() => { requested = false; render(); }); } }

  // One finger turns, two fingers move and zoom; in the image of a camera each of them moves and zooms the image.
  const held = new Map();
  canvas.addEventListener("pointerdown", event => { held.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, event => { held.delete(event.pointerId); });
  canvas.addEventListener("pointermove", event => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const dx = (event.clientX - before.clientX) / held.size, dy = (event.clientY - before.clientY) / held.size;
    const other = [...held.values()].find(each => each.pointerId !== event.pointerId);
    if (other) {
      const apart = each => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY);
      zoom(apart(before) / Math.max(apart(event), 1), event);
    }
    held.set(event.pointerId, event);
    if (eye.camera >= 0) {
      part.x += 2 * dx / canvas.clientWidth; part.y -= 2 * dy / canvas.clientHeight; keepPart();
    } else if (other || event.shiftKey || event.buttons === 2) {
      const scale = eye.distance * 0.0013;
      eye.target[0] -= Math.cos(eye.turn) * dx * scale; eye.target[1] -= Math.sin(eye.turn) * dx * scale; eye.target[2] += dy * scale;
    } else {
      eye.turn -= dx * 0.008; eye.lift = Math.min(1.5, Math.max(-0.3, eye.lift + dy * 0.006));
    }
    later(); scene.looked();
  });
  // The image of a camera fills the view or more, and is enlarged by 20 at most.
  function keepPart() {
    const most = part.scale - 1;
    part.x = Math.min(most, Math.max(-most, part.x)); part.y = Math.min(most, Math.max(-most, part.y));
  }
  function zoom(factor, event) {
    if (eye.camera < 0) { eye.distance = Math.min(reach[1], Math.max(reach[0], eye.distance * factor)); return; }
    const scale = Math.min(20, Math.max(1, part.scale / factor)), grown = scale / part.scale, box = canvas.getBoundingClientRect();
    const x = 2 * (event.clientX - box.left) / box.width - 1, y = 1 - 2 * (event.clientY - box.top) / box.height;
    part.x = x - grown * (x - part.x); part.y = y - grown * (y - part.y); part.scale = scale;
    keepPart();
  }
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("wheel", event => { zoom(Math.exp(event.deltaY * 0.001), event); event.preventDefault(); later(); scene.looked(); }, { passive: false });
  let turning = 0;
  function turn(on) {
    turning = on ? performance.now() : 0;
    if (on) requestAnimationFrame(go);
  }
  function go(now) {
    if (!turning) return;
    if (!held.size) eye.turn += 0.0005 * Math.max(0, now - turning);
    turning = now; later(); requestAnimationFrame(go);
  }
  // A drawing of the graphics card is empty on paper: a picture of it is printed instead.
  const printed = document.createElement("img"); printed.className = "printed"; printed.alt = canvas.getAttribute("aria-label") || "";
  canvas.after(printed);
  window.addEventListener("beforeprint", () => { render(); printed.src = canvas.toDataURL("image/png"); });
  scene.lookFrom = camera => { eye.camera = camera; Object.assign(part, { scale: 1, x: 0, y: 0 }); later(); };
  return scene;
}
// Names stand in a layer over the canvas; they are set where the picture has their points, and hidden where there is none.
function makeNames(canvas, texts) {
  const layer = document.createElement("div");
  layer.className = "names"; canvas.parentElement.appendChild(layer);
  const tags = texts.map(text => { const tag = document.createElement("span"); tag.textContent = text; layer.appendChild(tag); return tag; });
  const times = (m, v) => [0, 1, 2, 3].map(r => [0, 1, 2, 3].reduce((s, k) => s + m[4 * k + r] * v[k], 0));
  return (shown, points, view, lens) => {
    layer.hidden = !shown;
    if (!shown) return;
    points.forEach((point, p) => {
      const q = times(lens, times(view, [...point, 1]));
      tags[p].hidden = point[0] !== point[0] || q[3] <= 0;
      tags[p].style.left = `${(0.5 + 0.5 * q[0] / q[3]) * canvas.clientWidth + 6}px`;
      tags[p].style.top = `${(0.5 - 0.5 * q[1] / q[3]) * canvas.clientHeight - 6}px`;
    });
  };
}
const rgb = text => [1, 3, 5].map(i => parseInt(text.slice(i, i + 2), 16) / 255);
