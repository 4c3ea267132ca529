// The videos: pictures by frame number, loaded ahead while the page plays, and drawn with the body over them.
"use strict";

// Pixel of a point of the world [m], through the lens of a camera as in lens.py; null where it has no image.
function project(camera, point) {
  const [x0, y0, z0] = [0, 1, 2].map(r => camera.rotation[r][0] * point[0] + camera.rotation[r][1] * point[1] + camera.rotation[r][2] * point[2] + camera.translation[r]);
  if (!(z0 > 0)) return null;
  const x = x0 / z0, y = y0 / z0, s = x * x + y * y, m = camera.matrix, lens = camera.lens;
  let u = x, v = y;
  if (lens) {
    const k = lens.coefficients;
    if (lens.limit !== null && s > lens.limit) return null;
    if (lens.model === 1) {
      const r = Math.sqrt(s), angle = Math.atan(r), t = angle * angle, scale = r < 1e-4 ? 1 : angle * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))) / r;
      u = scale * x; v = scale * y;
    } else {
      const radial = (1 + s * (k[0] + s * (k[1] + s * k[4]))) / (1 + s * (k[5] + s * (k[6] + s * k[7])));
      u = x * radial + 2 * k[2] * x * y + k[3] * (s + 2 * x * x) + s * (k[8] + s * k[9]);
      v = y * radial + k[2] * (s + 2 * y * y) + 2 * k[3] * x * y + s * (k[10] + s * k[11]);
    }
  }
  return [m[0][0] * u + m[0][1] * v + m[0][2], m[1][1] * v + m[1][2]];
}

// Files are kept for many frames; only a few of them are decoded at a time, those that are shown next.
const MOST_KEPT = 240, MOST_READY = 6, AHEAD = 24, AT_ONCE = 8, AT_A_TIME = 2;

// Pictures by frame: the newest wanted frame is loaded first; while the page plays, the frames after it follow in groups.
function makeStream(load, arrived) {
  const kept = new Map(), ready = new Map(), inFlight = new Set(), decoding = new Set();
  let wanted = -1, ahead = false, loading = 0, version = 0, shown = -1;
  const away = frame => Math.abs(frame - wanted), nearest = frames => [...frames].reduce((a, b) => a < 0 || away(b) < away(a) ? b : a, -1);
  // The frame that is needed last: one before the wanted frame is needed later than one after it.
  const last = frames => [...frames].reduce((a, b) => { const far = f => f >= wanted ? f - wanted : 3 * (wanted - f); return a < 0 || far(b) > far(a) ? b : a; }, -1);
  const close = frame => { for (const p of ready.get(frame)) if (p) p.close(); ready.delete(frame); };

  // Where frames arrive more slowly than they are wanted, each one that is nearer than the last one is shown.
  function show() {
    const found = nearest(ready.keys());
    if (found >= 0 && found !== shown && (shown < 0 || away(found) < away(shown))) { shown = found; arrived(found, ready.get(found)); }
    const next = [kept.has(wanted) ? wanted : nearest(kept.keys()), ...(ahead ? [wanted + 1, wanted + 2] : [])];
    for (const frame of next) if (kept.has(frame) && (frame > wanted || shown < 0 || away(frame) < away(shown))) decode(frame);
  }
  function decode(frame) {
    if (ready.has(frame) || decoding.has(frame) || decoding.size >= AT_A_TIME) return;
    const own = version;
    decoding.add(frame);
    Promise.all(kept.get(frame).map(file => file && createImageBitmap(file).catch(() => null))).then(pictures => {
      if (own !== version) { for (const p of pictures) if (p) p.close(); return; }
      decoding.delete(frame); ready.set(frame, pictures);
      while (ready.size > MOST_READY) close(last([...ready.keys()].filter(each => each !== shown)));
      show();
    });
  }
  function fetchFrames(first, count) {
    const own = version, frames = Array.from({ length: count }, (_, i) => first + i);
    for (const frame of frames) inFlight.add(frame);
    loading++;
    load(first, count).then(rows => {
      if (own !== version) return;
      loading--;
      frames.forEach((frame, i) => { inFlight.delete(frame); kept.set(frame, rows[i]); });
      while (kept.size > MOST_KEPT) kept.delete(last(kept.keys()));
      show(); more();
    }, error => {
      if (own !== version) return;
      loading--; for (const frame of frames) inFlight.delete(frame);
      failed(error); setTimeout(more, 1000);
    });
  }
  function more() {
    if (wanted < 0 || loading >= AT_A_TIME) return;
    if (!kept.has(wanted) && !inFlight.has(wanted)) fetchFrames(wanted, 1);
    const end = ahead ? Math.min(time.length, wanted + AHEAD) : wanted;
    for (let frame = wanted + 1; frame < end && loading < AT_A_TIME; frame++) {
      let count = 0;
      while (count < AT_ONCE && frame + count < end && !kept.has(frame + count) && !inFlight.has(frame + count)) count++;
      if (count) { fetchFrames(frame, count); frame += count - 1; }
    }
  }
  return {
    want(frame, playing) { wanted = frame; ahead = playing; show(); more(); },
    clear() {
      version++; loading = 0; shown = wanted = -1; inFlight.clear(); decoding.clear(); kept.clear();
      for (const frame of [...ready.keys()]) close(frame);
    },
    get waiting() { return wanted >= 0 && shown !== wanted; },
  };
}

// The large picture of the camera that is looked at, and the small ones of all cameras, which wait for the large one.
function makePictures(drawLarge, drawSmalls) {
  const shown = { frame: -1, picture: null, smallFrame: -1, smalls: [] };
  const slot = frame => embedded ? Math.floor(frame / data.every) * data.every : frame;
  let chosen = -1, wanted = -1, timer = 0, plays = false;
  // Beside a large picture the small ones follow four times a second while the page plays, and else when it rests: the
  // server may have to decode hundreds of frames of each camera for them.
  function smallsLater() {
    if (timer && plays) return;
    clearTimeout(timer);
    timer = setTimeout(() => { timer = 0; small.want(slot(wanted), false); }, plays ? 250 : 400);
  }
  const small = makeStream((first, count) => loadPictures(first, count), (frame, pictures) => {
    shown.smallFrame = frame; shown.smalls = pictures; drawSmalls();
    if (chosen >= 0 && shown.frame < 0 && frame === slot(wanted)) drawLarge();
  });
  const large = makeStream((first, count) => loadPictures(first, count, chosen), (frame, pictures) => {
    shown.frame = frame; shown.picture = pictures[0]; drawLarge();
    smallsLater();
  });
  return {
    shown,
    want(frame, playing) {
      wanted = frame; plays = playing;
      const own = slot(frame);
      if (chosen >= 0) {
        large.want(own, playing && !embedded);
        if (large.waiting && !playing) { clearTimeout(timer); timer = 0; } else smallsLater();
      }
      if (chosen < 0) small.want(own, false);
    },
    look(camera) {
      if (camera === chosen) return;
      chosen = camera; large.clear(); shown.frame = -1; shown.picture = null;
      if (wanted >= 0 && chosen >= 0) large.want(slot(wanted), false);
    },
    // The frame of what is drawn for the camera: until its large picture is loaded, the small one.
    get frame() { return shown.frame >= 0 ? shown.frame : shown.smallFrame; },
    get picture() { return shown.picture || shown.smalls[chosen] || null; },
    get waiting() { return chosen >= 0 ? large.waiting : small.waiting; },
  };
}

// Without a graphics card, canvases in main memory are faster: others stop the drawing for half a second now and then.
const brush = canvas => canvas.getContext("2d", { willReadFrequently: inSoftware() });

// A picture fills its canvas as far as its shape allows; `part` enlarges and moves it as the scene does.
function drawPicture(canvas, picture, part) {
  const ratio = window.devicePixelRatio || 1, w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
  if (!w || !h) return;
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const g = brush(canvas);
  g.clearRect(0, 0, w, h);
  if (!picture) return;
  const fit = Math.min(w / picture.width, h / picture.height) * part.scale, pw = picture.width * fit, ph = picture.height * fit;
  g.drawImage(picture, (w * (1 + part.x) - pw) / 2, (h * (1 - part.y) - ph) / 2, pw, ph);
}

// The small picture of a camera with the joints over it.
function drawSmall(canvas, picture, camera, joints, places) {
  const height = Math.round(92 * (window.devicePixelRatio || 1)), width = Math.round(height * camera.size[0] / camera.size[1]);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; canvas.style.aspectRatio = `${width} / ${height}`; }
  const g = brush(canvas), scale = width / camera.size[0];
  g.clearRect(0, 0, width, height);
  if (picture) g.drawImage(picture, 0, 0, width, height);
  if (!joints) return;
  const pixels = places.map(place => place[0] === place[0] ? project(camera, place) : null);
  g.lineWidth = 1.5 * (window.devicePixelRatio || 1);
  for (const [a, b] of joints.bones) {
    if (!pixels[a] || !pixels[b]) continue;
    g.strokeStyle = joints.colours[b]; g.beginPath();
    g.moveTo((pixels[a][0] + 0.5) * scale, (pixels[a][1] + 0.5) * scale); g.lineTo((pixels[b][0] + 0.5) * scale, (pixels[b][1] + 0.5) * scale); g.stroke();
  }
}
