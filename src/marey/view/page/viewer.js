// The page of `marey view`: videos with the body over them, 3-D views and curves, all at one time.
"use strict";

const results = data.results, cameras = data.cameras, views = results.map(() => null), motions = results.map(() => null);
const rows = results.map(result => result.rows ? new Int32Array(bytes(result.rows)) : null);
const rowOf = (r, frame) => rows[r] ? rows[r][frame] : frame;
let camera = -1, over = false;
document.body.classList.toggle("two", results.length > 1);

const notices = new Map();
function notice(key, text) {
  if (text) notices.set(key, text); else notices.delete(key);
  byId("notice").textContent = [...notices.values()].join(" "); byId("notice").hidden = !notices.size;
}
notice("videos", data.without || (data.every > 1 ? `This file contains the pictures of one of ${data.every} frames.` : ""));
const failed = error => notice("server", `Some data could not be loaded (${error.message}). Is the command marey view still running?`);

const pictures = cameras.length ? makePictures(() => drawViews(), () => drawSmalls()) : null;
// The frame of the views: in the image of a camera, that of the image, so that body and image agree.
const viewedFrame = () => camera >= 0 && pictures.frame >= 0 ? pictures.frame : current;
const inCamera = r => camera >= 0 && (r === 0 || data.sameRoom);

function drawViews() {
  const frame = viewedFrame();
  results.forEach((result, r) => {
    const view = views[r], label = byId("label-" + r);
    byId("stage-" + r).classList.toggle("camera", inCamera(r));
    label.textContent = inCamera(r) ? `${result.name}, ${cameras[camera].name}` : result.name;
    if (inCamera(r)) drawImage(r);
    else byId("picture-" + r).style.display = "none";
    if (view && view.shown) view.shown.image = inCamera(r) && !!pictures.picture;
    if (view) view.show(rowOf(r, frame), ...(r === 0 && over ? [rowOf(1, frame)] : []));
  });
  document.body.dataset.frame = data.first + frame;
}
function drawImage(r) {
  const canvas = byId("picture-" + r);
  canvas.style.display = "";
  drawPicture(canvas, pictures.picture, views[r] ? views[r].scene.part : { scale: 1, x: 0, y: 0 });
  if (pictures.picture) document.body.dataset.picture = data.first + pictures.frame;
}
function drawSmalls() {
  if (!pictures || pictures.shown.smallFrame < 0) return;
  const { smallFrame, smalls: images } = pictures.shown;
  cameras.forEach((own, c) => {
    const joints = results[0].joints, motion = motions[0], row = rowOf(0, smallFrame), J = joints ? joints.names.length : 0;
    const places = motion && Array.from({ length: J }, (_, j) => motion.centres.subarray(3 * (row * J + j), 3 * (row * J + j) + 3));
    drawSmall(smalls[c], images[c], own, motion && joints, places);
  });
}

function showFrame(frame, fromUser) {
  current = Math.max(0, Math.min(time.length - 1, frame));
  player.follow(STATE_NAMES[state[current]]);
  for (const plot of plots) plot.update();
  motions.forEach((motion, r) => { if (motion) motion.at(Math.max(0, rowOf(r, current))).catch(failed); });
  if (fromUser) player.stop();
  if (pictures) pictures.want(current, player.playing);
  // Until a picture arrives, the image of a camera stays as it is: drawing it twice would take twice as long.
  if (camera < 0 || !pictures.waiting || pictures.frame < 0) drawViews();
}
const player = makePlayer();

// Cameras: small images from which one is chosen; 0 is the free view.
const smalls = [];
function look(next) {
  camera = next;
  views.forEach((view, r) => { if (view && view.lookFrom && (r === 0 || data.sameRoom)) view.lookFrom(next); });
  for (const button of byId("strip").children) button.setAttribute("aria-pressed", Number(button.dataset.camera) === next);
  if (pictures) pictures.look(next);
  drawViews();
}
function makeStrip() {
  if (!cameras.length) return;
  const add = (number, name, free) => {
    const button = document.createElement("button"), label = document.createElement("span");
    button.type = "button"; button.className = free ? "small free" : "small"; button.dataset.camera = number; label.textContent = `${number + 1} ${name}`;
    button.setAttribute("aria-pressed", number === camera);
    if (!free) { const canvas = document.createElement("canvas"); button.appendChild(canvas); smalls.push(canvas); }
    button.appendChild(label); byId("strip").appendChild(button);
    button.addEventListener("click", () => { look(number); button.blur(); });
  };
  add(-1, "3-D view", true);
  cameras.forEach((own, c) => add(c, own.name, false));
}

// The two 3-D views turn together.
function link(r) {
  const scene = views[r].scene;
  scene.looked = () => {
    if (inCamera(r)) drawImage(r);
    views.forEach((other, o) => {
      if (!other || o === r) return;
      const { eye, later, part } = other.scene, own = scene.eye, alike = results[o].kind === results[r].kind;
      Object.assign(eye, { turn: own.turn, lift: own.lift }, alike ? { distance: own.distance, target: own.target.slice() } : {});
      if (inCamera(o)) { Object.assign(part, scene.part); drawImage(o); }
      later();
    });
  };
  byId("scene-" + r).addEventListener("dblclick", () => { Object.assign(scene.part, { scale: 1, x: 0, y: 0 }); scene.looked(); scene.later(); });
}

async function bodyData(r) {
  const result = results[r], motion = makeMotion(r, result, () => { drawViews(); drawSmalls(); });
  motions[r] = motion;
  const first = motion.at(Math.max(0, rowOf(r, current))), body = result.hasBody ? await loadJson(`body/${r}`) : { segments: result.segments };
  await first;
  const own = r === 0 || data.sameRoom ? cameras : [];
  return { replay: { ...body, rotation: motion.rotation, origin: motion.origin, cameras: own }, joints: { ...result.joints, centres: motion.centres }, middle: result.middle, floor: result.floor, trail: 60 };
}
async function makeViews() {
  const loading = results.map((result, r) => result.kind === "body" ? bodyData(r) : loadJson(`markers/${r}`));
  inSoftware();
  const loaded = await Promise.all(loading);
  loaded.forEach((own, r) => {
    const canvas = byId("scene-" + r), problem = byId("problem-" + r);
    views[r] = results[r].kind === "body" ? makeReplay(canvas, problem, own, r === 0 && data.sameRoom ? [loaded[1]] : []) : makeMarkers(canvas, problem, own);
    if (views[r]) link(r);
  });
  makeChoices(loaded);
  look(camera); drawSmalls();
}

function makeChoices(loaded) {
  const add = (text, on, change) => {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox"; box.checked = on; label.append(box, ` ${text}`); byId("choices").appendChild(label);
    box.addEventListener("change", () => { change(box.checked); box.blur(); });
  };
  const each = (kind, what) => on => views.forEach((view, r) => { if (view && results[r].kind === kind) view.toggle(what, on); });
  if (data.sameRoom) add(`${results[1].name} over ${results[0].name}`, false, on => { over = on; byId("stage-1").hidden = on; byId("stage-1").style.display = on ? "none" : ""; drawViews(); });
  if (results.some(result => result.kind === "body")) {
    for (const [what, text, on] of [["surface", "surface", true], ["bones", "joints", true], ["trails", "paths", false], ["floor", "floor", true]]) add(text, on, each("body", what));
  }
  const scene = loaded[results.findIndex(result => result.kind === "markers")];
  if (!scene) return;
  for (const [what, text, on] of [["markers", "markers", true], ["bones", "bones", true], ["lines", "lines", true], ["trails", "paths of markers", false], ["labels", "labels", false]]) add(text, on, each("markers", what));
  if (scene.forces.length) add("forces", true, each("markers", "forces"));
  add("follow the markers", true, on => { for (const view of views) if (view && view.follow) view.follow(on); });
}

// Curves: the values of a group are loaded when it is chosen.
const groups = new Map();
async function makeGroup(g) {
  const values = new Float32Array(await loadPart(`curves/${g}`)), n = time.length;
  let at = 0;
  const next = () => values.subarray(at, at += n), made = document.createDocumentFragment();
  const own = data.groups[g].plots.map(entry => {
    const curves = entry.curves.map(c => {
      const y = next(), made = curve(y, c.sd ? next() : null, 1, 0, c.label, c.colour);
      return Object.assign(made, { sure: c.determined ? next() : null });
    });
    return new Plot(made, entry.title, curves, { unit: entry.unit, least: entry.least, digits: entry.digits, marks: entry.marks });
  });
  groups.set(g, own);
  byId("plots").appendChild(made);
  return own;
}
async function chooseGroup(g) {
  for (const button of byId("groups").children) button.setAttribute("aria-pressed", Number(button.dataset.group) === g);
  const own = groups.get(g) || await makeGroup(g);
  for (const [other, members] of groups) for (const plot of members) plot.figure.style.display = other === g ? "" : "none";
  plots.length = 0; plots.push(...own);
  for (const plot of own) plot.draw();
}
function makeGroups() {
  data.groups.forEach((group, g) => {
    const button = document.createElement("button");
    button.type = "button"; button.textContent = group.title; button.dataset.group = g;
    button.addEventListener("click", () => { chooseGroup(g).catch(failed); button.blur(); });
    byId("groups").appendChild(button);
  });
  const first = data.groups.findIndex(group => group.title === "knee");
  if (data.groups.length) chooseGroup(Math.max(0, first)).catch(failed);
}

// Gait events over the slider: strikes are full ticks, offs short ones.
const frameOf = seconds => Math.round((seconds - time[0]) * data.rate);
function drawEvents() {
  const canvas = byId("events"), ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight, inset = 8;
  canvas.width = w * ratio; canvas.height = h * ratio;
  const g = plotBrush(canvas); g.scale(ratio, ratio);
  for (const event of data.events) {
    const x = inset + (w - 2 * inset) * frameOf(event.time) / Math.max(1, time.length - 1);
    g.fillStyle = event.colour; g.fillRect(x - 1, event.strike ? 0 : h / 2, 2, event.strike ? h : h / 2);
  }
}

document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  if (/^[0-9]$/.test(event.key) && Number(event.key) <= cameras.length) look(Number(event.key) - 1);
  if (event.key === "[" || event.key === "]") {
    const frames = data.events.map(each => frameOf(each.time)), next = event.key === "]";
    const found = next ? frames.find(frame => frame > current) : frames.reverse().find(frame => frame < current);
    if (found !== undefined) showFrame(found, true);
  }
  if (event.key === "Escape") keys(false);
});
function keys(open) { byId("key-list").hidden = !open; byId("keys").setAttribute("aria-expanded", open); }
byId("keys").addEventListener("click", event => { keys(byId("key-list").hidden); event.target.blur(); });

const drawAll = () => { for (const plot of plots) plot.draw(); drawEvents(); drawViews(); drawSmalls(); };
window.addEventListener("resize", drawAll);
makeStrip(); makeGroups();
// An address that ends in #frame=120&camera=2 opens at that frame, with the image of the second camera.
const linked = /frame=(\d+)/.exec(location.hash), chosen = /camera=(\d+)/.exec(location.hash);
showFrame(linked ? Number(linked[1]) - data.first : Math.max(0, state.findIndex(s => s === 1)), false);
if (chosen && Number(chosen[1]) <= cameras.length) look(Number(chosen[1]) - 1);
makeViews().catch(failed);
// Last, because the first layout of the page takes a while: all requests are under way then.
drawEvents();
