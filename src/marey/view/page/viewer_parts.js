// The parts of the page's data: from the server by which the page was opened, or from the page itself.
"use strict";

const embedded = JSON.parse(byId("embedded").textContent);
const asBytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));

async function loadPart(name) {
  if (embedded) {
    if (!(name in embedded)) throw new Error(`the page has no ${name}`);
    return asBytes(embedded[name]).buffer;
  }
  const response = await fetch(`part/${name}`);
  if (!response.ok) throw new Error(`${name}: ${response.status}`);
  return response.arrayBuffer();
}
const loadJson = async name => JSON.parse(new TextDecoder().decode(await loadPart(name)));

// JPEG files of one camera for some frames of the page, or without a camera those of all cameras; null where there is none.
async function loadPictures(first, count, camera) {
  const all = embedded || camera === undefined, C = all ? data.cameras.length : 1;
  let buffer;
  if (embedded) buffer = await loadPart(`pictures/${first}`);
  else {
    const response = await fetch(`pictures?first=${data.first + first}&count=${count}${all ? "" : `&camera=${camera}`}`);
    if (!response.ok) throw new Error(`pictures: ${response.status}`);
    buffer = await response.arrayBuffer();
  }
  const lengths = new Uint32Array(buffer.slice(0, 4 * count * C)), made = [];
  let at = 4 * count * C;
  for (const length of lengths) {
    made.push(length ? new Blob([new Uint8Array(buffer, at, length)], { type: "image/jpeg" }) : null);
    at += length;
  }
  return Array.from({ length: count }, (_, f) => camera === undefined ? made.slice(f * C, (f + 1) * C) : [made[f * C + (embedded ? camera : 0)]]);
}

// The motion of a result: arrays over all frames that contain NaN until their chunk is loaded.
function makeMotion(number, result, changed) {
  const F = result.frames, S = result.segments, J = result.joints.names.length;
  const origin = new Float32Array(3 * F * S).fill(NaN), rotation = new Float32Array(9 * F * S), centres = new Float32Array(3 * F * J).fill(NaN);
  const wanted = new Map();
  function load(chunk) {
    if (wanted.has(chunk) || chunk < 0 || chunk * data.chunk >= F) return wanted.get(chunk) || Promise.resolve();
    const made = loadPart(`motion/${number}/${chunk}`).then(buffer => {
      const first = chunk * data.chunk, n = Math.min(data.chunk, F - first), places = 12 * n * S, joints = 12 * n * J;
      origin.set(new Float32Array(buffer, 0, 3 * n * S), 3 * first * S);
      centres.set(new Float32Array(buffer, places, 3 * n * J), 3 * first * J);
      const turned = new Int16Array(buffer, places + joints, 9 * n * S), from = 9 * first * S;
      for (let i = 0; i < turned.length; i++) rotation[from + i] = turned[i] / 32767;
      changed();
    }).catch(error => { wanted.delete(chunk); throw error; });
    wanted.set(chunk, made);
    return made;
  }
  return {
    origin, rotation, centres,
    // Load the chunk of a frame, and the next one in advance.
    at(frame) {
      const chunk = Math.floor(frame / data.chunk);
      return load(chunk).then(() => { if (frame % data.chunk > data.chunk / 2) load(chunk + 1).catch(() => {}); });
    },
  };
}
