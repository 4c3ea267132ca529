// The page of `marey knee outline`: slices, the live wire at the pointer, anchors, and the outlines stored by the server.
"use strict";

const NEAR_ANCHOR = 9, NEAR_OUTLINE = 6;
const $ = (id) => document.getElementById(id);
const view = $("view"), strip = $("strip");
const picture = document.createElement("canvas");

let axis = about.axis, index = about.index, structure = about.structures[0];
let greys = null, kept = { version: 0, contours: [], slices: {}, axes: {}, undo: false }, between = {};
let draft = [], wire = null, drag = null, preview = null, pointer = null, hover = null;
let zoom = 1, shift = [0, 0];
let level = (about.window[0] + about.window[1]) / 2, width = about.window[1] - about.window[0];

async function request(path, body) {
  const how = body === undefined ? {} : { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  const response = await fetch(`.${path}`, how);  // below the secret path of the page
  if (!response.ok) { const { error } = await response.json(); throw new Error(error); }
  return response;
}
const fetchJson = async (path, body) => (await request(path, body)).json();
function showMessage(text) { $("message").textContent = text; }
async function attempt(work) { try { showMessage(""); return await work(); } catch (error) { showMessage(error.message); return null; } }

// Transform from pixels of the slice to the screen, and its inverse.
function fit() {
  const { rows, columns, screen_mm: [a, b, c, d] } = about.axes[axis];
  const wide = Math.abs(a) * columns + Math.abs(b) * rows, high = Math.abs(c) * columns + Math.abs(d) * rows;
  const scale = zoom * Math.min(view.clientWidth / wide, view.clientHeight / high) * 0.96;
  const middle = [(columns - 1) / 2, (rows - 1) / 2];
  const u = view.clientWidth / 2 + shift[0] - scale * (a * middle[0] + b * middle[1]);
  const v = view.clientHeight / 2 + shift[1] - scale * (c * middle[0] + d * middle[1]);
  return { a: a * scale, b: b * scale, c: c * scale, d: d * scale, u, v };
}
function onScreen([x, y], m = fit()) { return [m.a * x + m.b * y + m.u, m.c * x + m.d * y + m.v]; }
function inSlice([u, v], m = fit()) {
  const by = m.a * m.d - m.b * m.c, p = u - m.u, q = v - m.v;
  return [(m.d * p - m.b * q) / by, (m.a * q - m.c * p) / by];
}

function paint() {
  if (!greys) return;
  const { rows, columns } = about.axes[axis];
  picture.width = columns; picture.height = rows;
  const to = picture.getContext("2d"), image = to.createImageData(columns, rows), data = image.data;
  const [low, high] = about.range, factor = (high - low) / 65535, from = level - width / 2;
  for (let i = 0; i < greys.length; i++) {
    const grey = 255 * (low + factor * greys[i] - from) / width;
    data[4 * i] = data[4 * i + 1] = data[4 * i + 2] = grey; data[4 * i + 3] = 255;
  }
  to.putImageData(image, 0, 0);
  draw();
}

function line(to, points, m, close) {
  to.beginPath();
  points.forEach((point, n) => { const [u, v] = onScreen(point, m); n ? to.lineTo(u, v) : to.moveTo(u, v); });
  if (close) to.closePath();
  to.stroke();
}
function dots(to, points, m, colour, marked) {
  points.forEach((point, n) => {
    const [u, v] = onScreen(point, m);
    to.beginPath(); to.arc(u, v, n === marked ? 6 : 4, 0, 2 * Math.PI);
    to.fillStyle = n === marked ? "#fff" : colour; to.fill();
    to.lineWidth = 1; to.strokeStyle = "#000"; to.stroke();
  });
}
const colourOf = (name) => about.colours[name];

function draw() {
  const ratio = window.devicePixelRatio || 1;
  view.width = view.clientWidth * ratio; view.height = view.clientHeight * ratio;
  const to = view.getContext("2d"), m = fit();
  to.setTransform(ratio, 0, 0, ratio, 0, 0);
  to.save();
  to.transform(m.a, m.c, m.b, m.d, m.u, m.v);
  to.imageSmoothingEnabled = Math.hypot(m.a, m.c) < 6;
  to.drawImage(picture, -0.5, -0.5);
  to.restore();
  to.lineJoin = "round";
  for (const [name, lines] of Object.entries(between)) {
    to.strokeStyle = colourOf(name); to.lineWidth = 1.5; to.setLineDash([6, 5]);
    lines.forEach((each) => line(to, each, m, true));
  }
  to.setLineDash([]);
  for (const stored of kept.contours) {
    const contour = preview && preview.number === stored.number ? preview : stored, colour = colourOf(contour.structure);
    to.strokeStyle = colour; to.lineWidth = contour.structure === structure ? 2 : 1.2;
    line(to, contour.outline, m, true);
    if (contour.structure === structure) {
      const marked = hover && hover.number === contour.number ? hover.anchor : drag && drag.number === contour.number ? drag.anchor : -1;
      dots(to, contour.anchors, m, colour, marked);
    }
  }
  if (draft.length) {
    const colour = colourOf(structure);
    to.strokeStyle = colour; to.lineWidth = 2;
    if (wire) { line(to, wire.fixed, m); to.strokeStyle = "#fff"; to.lineWidth = 1.5; line(to, wire.live, m); }
    dots(to, wire ? wire.anchors : draft, m, colour, -1);
  }
}

function drawStrip() {
  const ratio = window.devicePixelRatio || 1, wide = strip.clientWidth, high = strip.clientHeight;
  strip.width = wide * ratio; strip.height = high * ratio;
  const to = strip.getContext("2d"), count = about.counts[axis], place = (n) => 2 + (n + 0.5) / count * (wide - 4);
  to.scale(ratio, ratio);
  const has = kept.axes[structure] === axis ? kept.slices[structure] || [] : [];
  to.fillStyle = colourOf(structure);
  if (has.length > 1) { to.globalAlpha = 0.3; to.fillRect(place(has[0]), 8, place(has[has.length - 1]) - place(has[0]), 6); to.globalAlpha = 1; }
  has.forEach((n) => to.fillRect(place(n) - 1.5, 3, 3, 16));
  to.fillStyle = "#fff"; to.fillRect(place(index) - 0.75, 0, 1.5, 22);
}

function showState() {
  document.querySelectorAll(".structure").forEach((button) => {
    const name = button.dataset.name, count = (kept.slices[name] || []).length;
    button.setAttribute("aria-pressed", name === structure);
    button.querySelector("span").textContent = count ? `${count} slice${count > 1 ? "s" : ""}` : "";
  });
  const has = kept.slices[structure] || [], other = kept.axes[structure];
  $("kept").textContent = other && other !== axis ? `This structure is outlined across ${other}.` : has.length ? `Stored in ${about.file}` : `Will be stored in ${about.file}`;
  $("where").textContent = `${index} of 0–${about.counts[axis] - 1}`;
  $("slider").max = about.counts[axis] - 1; $("slider").value = index; $("axis").value = axis;
  const own = kept.contours.some((each) => each.structure === structure);
  $("close").disabled = draft.length < 2; $("undo").disabled = !draft.length && !kept.undo;
  $("remove").disabled = !own || draft.length > 0; $("accept").disabled = !between[structure] || draft.length > 0;
  const [left, right, top, bottom] = about.axes[axis].sides;
  $("left").textContent = left; $("right").textContent = right; $("top").textContent = top; $("bottom").textContent = bottom;
  $("level").value = (level - about.range[0]) / (about.range[1] - about.range[0]);
  $("window").value = width / (about.range[1] - about.range[0]);
  drawStrip(); draw();
}

let shown = 0;
async function show(newAxis, newIndex) {
  if (draft.length) { showState(); showMessage("Close the outline first (Enter), or discard it (Escape)."); return; }
  axis = newAxis; index = Math.max(0, Math.min(about.counts[axis] - 1, newIndex));
  const mine = ++shown, where = `axis=${axis}&index=${index}`;
  wire = null; preview = null; drag = null; hover = null; between = {};
  await attempt(async () => {
    const [pixels, state] = await Promise.all([request(`/slice?${where}`).then((each) => each.arrayBuffer()), fetchJson(`/state?${where}`)]);
    if (mine !== shown) return;
    greys = new Uint16Array(pixels); kept = state;
    paint(); showState();
    await new Promise((later) => setTimeout(later, 120));
    if (mine !== shown) return;
    between = await fetchJson(`/interpolated?${where}`);
    if (mine !== shown) return;
    showState();
    await fetchJson("/prepare", { axis, index, structure });
  });
}
async function showReply(state) {
  if (!state) return;
  kept = state; preview = null;
  showState();
  const mine = shown;
  const lines = await attempt(() => fetchJson(`/interpolated?axis=${axis}&index=${index}`));
  if (lines && mine === shown) { between = lines; showState(); await attempt(() => fetchJson("/prepare", { axis, index, structure })); }
}

// The wire: one request at a time, always for the latest position of the pointer.
let busy = false, waiting = null;
async function latest(work) {
  waiting = work;
  if (busy) return;
  busy = true;
  while (waiting) { const now = waiting; waiting = null; await attempt(now); }
  busy = false;
}
function follow() {
  if (!draft.length || !pointer) return;
  const at = inSlice(pointer), mine = shown, count = draft.length;
  latest(async () => {
    const started = performance.now(), found = await fetchJson("/wire", { axis, index, structure, anchors: draft, pointer: at });
    if (mine !== shown || draft.length !== count) return;
    wire = found; $("timing").textContent = `wire ${(performance.now() - started).toFixed(0)} ms`;
    draw();
  });
}
async function closeDraft() {
  if (draft.length < 2) return;
  const anchors = draft;
  const state = await attempt(() => fetchJson("/close", { axis, index, structure, anchors }));
  if (!state) return;
  draft = []; wire = null;
  await showReply(state);
}
async function undo() {
  if (draft.length) { draft.pop(); wire = null; follow(); showState(); } else await showReply(await attempt(() => fetchJson("/undo", { axis, index })));
}
async function removeOutline() {
  const own = kept.contours.filter((each) => each.structure === structure);
  if (own.length) await showReply(await attempt(() => fetchJson("/remove", { version: kept.version, number: (hover && hover.number) ?? own[own.length - 1].number })));
}

function nearest(place) {
  const m = fit(), own = kept.contours.filter((each) => each.structure === structure);
  let best = null;
  const away = (point) => { const [u, v] = onScreen(point, m); return Math.hypot(u - place[0], v - place[1]); };
  for (const contour of own) {
    contour.anchors.forEach((point, anchor) => {
      const far = away(point);
      if (far < NEAR_ANCHOR && (!best || far < best.far)) best = { number: contour.number, anchor, far };
    });
  }
  if (best) return best;
  for (const contour of own) {
    const far = Math.min(...contour.outline.map(away));
    if (far < NEAR_OUTLINE && (!best || far < best.far)) best = { number: contour.number, anchor: -1, far };
  }
  return best;
}
const placeOf = (event) => { const box = view.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };

view.addEventListener("pointerdown", async (event) => {
  view.setPointerCapture(event.pointerId);
  pointer = placeOf(event);
  if (event.button === 2) { drag = { grey: true, from: pointer, level, width }; return; }
  if (event.button === 1 || event.shiftKey) { drag = { picture: true, from: pointer, shift: [...shift] }; return; }
  const found = draft.length ? null : nearest(pointer);
  if (found) {
    drag = { number: found.number, anchor: found.anchor, moved: false };
    if (found.anchor < 0) {
      const mine = drag, state = await attempt(() => fetchJson("/insert", { version: kept.version, number: found.number, point: inSlice(pointer) }));
      if (state) { mine.anchor = state.anchor; kept = state; showState(); }
    }
    return;
  }
  if (event.detail > 1 && draft.length) return;  // the second click of a double click sets no anchor
  draft.push(inSlice(pointer)); wire = null;
  showState(); follow();
});
view.addEventListener("pointermove", (event) => {
  pointer = placeOf(event);
  if (drag && drag.grey) {
    const whole = about.range[1] - about.range[0];
    width = Math.max(whole * 0.004, drag.width + (pointer[0] - drag.from[0]) / 600 * whole); level = drag.level + (drag.from[1] - pointer[1]) / 600 * whole;
    paint(); showState();
  } else if (drag && drag.picture) {
    shift = [drag.shift[0] + pointer[0] - drag.from[0], drag.shift[1] + pointer[1] - drag.from[1]]; draw();
  } else if (drag && drag.anchor >= 0) {
    drag.moved = true;
    const { number, anchor } = drag, point = inSlice(pointer), version = kept.version;
    latest(async () => {
      const started = performance.now(), found = await fetchJson("/move", { version, number, anchor, point, keep: false });
      if (!drag || drag.number !== number) return;
      preview = found.contour; $("timing").textContent = `wire ${(performance.now() - started).toFixed(0)} ms`;
      draw();
    });
  } else if (draft.length) follow();
  else { const found = nearest(pointer); if (JSON.stringify(found) !== JSON.stringify(hover)) { hover = found; draw(); } }
});
view.addEventListener("pointerup", async () => {
  const done = drag;
  drag = null;
  if (!done || done.grey || done.picture || !done.moved || done.anchor < 0) return;
  waiting = null;
  await showReply(await attempt(() => fetchJson("/move", { version: kept.version, number: done.number, anchor: done.anchor, point: inSlice(pointer), keep: true })));
});
view.addEventListener("dblclick", closeDraft);
view.addEventListener("contextmenu", (event) => event.preventDefault());
$("stage").addEventListener("wheel", (event) => {
  event.preventDefault();
  if (event.ctrlKey) zoomBy(event.deltaY < 0 ? 1.15 : 1 / 1.15, placeOf(event));
  else show(axis, index + (event.deltaY > 0 ? 1 : -1));
}, { passive: false });
function zoomBy(factor, place) {
  const kept_at = inSlice(place);
  zoom = Math.max(0.5, Math.min(20, zoom * factor));
  const [u, v] = onScreen(kept_at);
  shift = [shift[0] + place[0] - u, shift[1] + place[1] - v];
  draw();
}
function chosen(name) {
  if (draft.length) { showMessage("Close the outline first (Enter), or discard it (Escape)."); return; }
  structure = name; hover = null;
  showState();
  attempt(() => fetchJson("/prepare", { axis, index, structure }));
}
async function removeAnchor() {
  if (hover && hover.anchor >= 0) await showReply(await attempt(() => fetchJson("/remove_anchor", { version: kept.version, number: hover.number, anchor: hover.anchor })));
}
window.addEventListener("keydown", (event) => {
  const middle = [view.clientWidth / 2, view.clientHeight / 2];
  const keys = {
    Enter: closeDraft, Escape: () => { draft = []; wire = null; showMessage(""); showState(); }, Backspace: () => draft.length && undo(), Delete: removeAnchor,
    ArrowUp: () => show(axis, index + 1), ArrowDown: () => show(axis, index - 1), PageUp: () => show(axis, index + 8), PageDown: () => show(axis, index - 8),
    "+": () => zoomBy(1.25, middle), "-": () => zoomBy(0.8, middle), 0: () => { zoom = 1; shift = [0, 0]; draw(); }, a: () => $("accept").click(),
  };
  about.structures.forEach((name, n) => { keys[n + 1] = () => chosen(name); });
  const work = (event.ctrlKey || event.metaKey) ? (event.key === "z" ? undo : null) : keys[event.key];
  if (work) { event.preventDefault(); work(); }
});
window.addEventListener("resize", () => { drawStrip(); draw(); });

for (const name of Object.keys(about.axes)) $("axis").append(new Option(`${name} (${about.counts[name]})`, name));
about.structures.forEach((name) => {
  const button = document.createElement("button"), mark = document.createElement("i");
  button.className = "structure"; button.dataset.name = name; mark.style.background = about.colours[name];
  button.append(mark, name.replace("_", " "), document.createElement("span"));
  button.addEventListener("click", () => chosen(name));
  $("structures").append(button);
});
$("axis").addEventListener("change", () => { zoom = 1; shift = [0, 0]; show($("axis").value, Math.floor(about.counts[$("axis").value] / 2)); });
$("slider").addEventListener("input", () => show(axis, Number($("slider").value)));
strip.addEventListener("click", (event) => show(axis, Math.floor(event.offsetX / strip.clientWidth * about.counts[axis])));
$("level").addEventListener("input", () => { level = about.range[0] + $("level").value * (about.range[1] - about.range[0]); paint(); });
$("window").addEventListener("input", () => { width = $("window").value * (about.range[1] - about.range[0]); paint(); });
$("close").addEventListener("click", closeDraft);
$("undo").addEventListener("click", undo);
$("remove").addEventListener("click", removeOutline);
$("accept").addEventListener("click", async () => showReply(await attempt(() => fetchJson("/accept", { axis, index, structure }))));
show(axis, index);
