// Curves with bands over the frames of a take: drawn on canvases, read at a shared cursor.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
// Numbers that are packed as text; arrays that the page has already are returned as they are.
const floats = packed => typeof packed === "string" ? new Float32Array(bytes(packed)) : packed;
const time = floats(data.time), state = new Uint8Array(bytes(data.state));
const STATE_NAMES = ["no person", "measured", "filled", "lost"];
const STATE_COLOURS = ["#e9ecef", null, "#f6e7c1", "#f3d3d1"];
const MARGIN = { left: 40, right: 6, top: 6, bottom: 20 };
const plots = [];
let current = 0;
// Curves are drawn in main memory: the graphics card would first draw all of them, and the 3-D view would wait for it.
const plotBrush = canvas => canvas.getContext("2d", { willReadFrequently: true });
window.addEventListener("beforeprint", () => { for (const folded of document.querySelectorAll("details")) folded.open = true; });

// One curve: every `step`-th value from `start` on, with standard deviations where there are any.
function curve(values, sd, count, index, label, colour, n = time.length) {
  const y = new Float32Array(n), half = new Float32Array(n);
  for (let i = 0; i < n; i++) {
    y[i] = values[i * count + index];
    half[i] = sd ? 1.96 * sd[i * count + index] : 0;
  }
  return { y, half, label, colour };
}

// A number as people read it: a true minus sign, and no minus before a zero.
function readable(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? (0).toFixed(digits) : text.replace("-", "−");
}

function niceStep(span, wanted) {
  const raw = span / wanted, power = Math.pow(10, Math.floor(Math.log10(raw)));
  return power * [1, 2, 5, 10].find(m => m * power >= raw);
}

// Range of the curves; a band may widen it, but an undetermined value must not flatten everything else.
function valueRange(curves, least) {
  let low = Infinity, high = -Infinity;
  for (const c of curves) for (const v of c.y) if (v === v) { low = Math.min(low, v); high = Math.max(high, v); }
  if (low > high) return [0, 1];
  const room = Math.max(0.5 * (high - low), least);
  let widest = 0;
  for (const c of curves) for (let i = 0; i < c.y.length; i++) if (c.half[i] === c.half[i]) widest = Math.max(widest, c.half[i]);
  const pad = Math.max(0.05 * (high - low), Math.min(1.08 * widest, room), 0.25 * least);
  return [low - pad, high + pad];
}

// Buttons that save a plot: its numbers as a table, and its picture with title and legend.
function addSaving(figure, title, legend, table) {
  const box = document.createElement("span"); box.className = "save";
  const name = title.replace(/[^\w%]+/g, "_").replace(/^_|_$/g, "") || "curves", canvas = figure.querySelector("canvas");
  for (const [kind, address] of [["CSV", () => URL.createObjectURL(new Blob([table()], { type: "text/csv" }))], ["PNG", () => picture(canvas, title, legend())]]) {
    const button = document.createElement("button"); button.type = "button"; button.textContent = kind; button.title = `save ${title || "the curves"} as ${kind}`;
    button.addEventListener("click", () => {
      const link = document.createElement("a"); link.href = address(); link.download = `${name}.${kind.toLowerCase()}`; link.click();
    });
    box.appendChild(button);
  }
  figure.querySelector("figcaption").appendChild(box);
}

function picture(canvas, title, legend) {
  const ratio = canvas.width / canvas.clientWidth, head = 24 * ratio, made = document.createElement("canvas");
  made.width = canvas.width; made.height = canvas.height + head;
  const g = plotBrush(made); g.fillStyle = "#fff"; g.fillRect(0, 0, made.width, made.height);
  g.scale(ratio, ratio); g.font = "600 13px system-ui, sans-serif"; g.textBaseline = "middle"; g.fillStyle = "#1d232b"; g.fillText(title, 6, 12);
  let at = 14 + g.measureText(title).width; g.font = "12px system-ui, sans-serif";
  for (const [label, colour] of legend) { g.fillStyle = colour; g.fillText(label, at, 12); at += 10 + g.measureText(label).width; }
  g.setTransform(1, 0, 0, 1, 0, 0); g.drawImage(canvas, 0, head);
  return made.toDataURL("image/png");
}

// A table as text: unknown values are empty cells.
function csv(head, columns) {
  const cell = v => typeof v === "string" ? `"${v.replaceAll('"', '""')}"` : v === v && v !== null ? String(+v.toPrecision(7)) : "";
  return [head.map(cell), ...Array.from(columns[0], (_, i) => columns.map(c => cell(c[i])))].map(row => row.join(",")).join("\n") + "\n";
}

class Plot {
  constructor(parent, title, curves, options) {
    this.curves = curves; this.options = Object.assign({ least: 14, digits: 1, unit: "°", reads: Infinity }, options);
    // A plot over something else than the take's frames, such as a cycle, brings its own axis and cursor.
    this.time = this.options.time || time; this.state = this.options.time ? [] : state; this.own = this.options.time ? 0 : null;
    this.figure = document.createElement("figure"); this.figure.className = "plot";
    this.figure.innerHTML = "<figcaption><span></span><span class='read'></span></figcaption><canvas></canvas><div class='cursor'></div>";
    this.figure.querySelector("span").textContent = title;
    this.read = this.figure.querySelector(".read"); this.canvas = this.figure.querySelector("canvas");
    this.line = this.figure.querySelector(".cursor");
    parent.appendChild(this.figure);
    addSaving(this.figure, title, () => this.curves.map(c => [c.label, c.colour]), () => this.table());
    this.range = this.options.range || valueRange(curves, this.options.least);
    const go = event => {
      if (event.type !== "click" && event.buttons !== 0) return;
      const frame = this.frameAt(event.offsetX);
      if (this.own === null) showFrame(frame, event.type === "click"); else { this.own = frame; this.update(); }
    };
    this.canvas.addEventListener("mousemove", go); this.canvas.addEventListener("click", go);
    plots.push(this);
  }
  table() {
    const unit = this.options.unit.trim(), head = [this.options.time ? "axis" : "time [s]"], columns = [this.time];
    for (const c of this.curves) {
      head.push(unit ? `${c.label} [${unit}]` : c.label); columns.push(c.y);
      if (c.half.some(v => v > 0)) { head.push(`${c.label} sd`); columns.push(c.half.map(v => v / 1.96)); }
      if (c.sure) { head.push(`${c.label} determined`); columns.push(Array.from(c.sure, (v, i) => c.y[i] === c.y[i] ? v : null)); }
    }
    return csv(head, columns);
  }
  x(i) { return MARGIN.left + (this.width - MARGIN.left - MARGIN.right) * (this.time.length > 1 ? i / (this.time.length - 1) : 0.5); }
  y(v) { const [a, b] = this.range; return this.height - MARGIN.bottom - (this.height - MARGIN.top - MARGIN.bottom) * (v - a) / (b - a); }
  frameAt(x) {
    const share = (x - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right);
    return Math.round(Math.min(1, Math.max(0, share)) * (this.time.length - 1));
  }
  draw() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth; this.height = this.canvas.clientHeight;
    if (!this.width) return;
    this.canvas.width = this.width * ratio; this.canvas.height = this.height * ratio;
    const g = plotBrush(this.canvas); g.scale(ratio, ratio);
    this.drawStates(g); this.drawAxes(g);
    g.save(); g.beginPath();
    g.rect(MARGIN.left, MARGIN.top, this.width - MARGIN.left - MARGIN.right, this.height - MARGIN.top - MARGIN.bottom); g.clip();
    for (const c of this.curves) this.drawBand(g, c);
    this.drawMarks(g);
    for (const c of this.curves) this.drawLine(g, c);
    g.restore();
    this.update();
  }
  drawStates(g) {
    const half = (this.x(1) - this.x(0)) / 2 || 2, bottom = this.height - MARGIN.top - MARGIN.bottom;
    for (let i = 0; i < this.state.length;) {
      let j = i; while (j < this.state.length && this.state[j] === this.state[i]) j++;
      const colour = STATE_COLOURS[this.state[i]];
      if (colour) {
        const a = Math.max(MARGIN.left, this.x(i) - half), b = Math.min(this.width - MARGIN.right, this.x(j - 1) + half);
        g.fillStyle = colour; g.fillRect(a, MARGIN.top, b - a, bottom);
      }
      i = j;
    }
  }
  drawAxes(g) {
    g.font = "11px system-ui, sans-serif"; g.fillStyle = "#5b6570"; g.lineWidth = 1;
    const [a, b] = this.range, step = niceStep(b - a, 4), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    g.textAlign = "right"; g.textBaseline = "middle";
    for (let v = Math.ceil(a / step) * step; v <= b + 1e-9; v += step) {
      const y = Math.round(this.y(v)) + 0.5;
      g.strokeStyle = Math.abs(v) < step * 1e-6 ? "#aab3bc" : "#e3e7eb";
      g.beginPath(); g.moveTo(MARGIN.left, y); g.lineTo(this.width - MARGIN.right, y); g.stroke();
      g.fillText(readable(v, digits), MARGIN.left - 6, y);
    }
    const first = this.time[0], span = this.time[this.time.length - 1] - first || 1, stride = niceStep(span, this.width / 80);
    g.textAlign = "center"; g.textBaseline = "top";
    for (let t = Math.ceil(first / stride) * stride; t <= first + span + 1e-9; t += stride) {
      const x = this.x((t - first) / span * (this.time.length - 1));
      g.fillText(+t.toFixed(3), Math.min(x, this.width - 12), this.height - MARGIN.bottom + 5);
    }
  }
  runs(c) {
    const found = [];
    for (let i = 0; i < c.y.length;) {
      if (c.y[i] !== c.y[i]) { i++; continue; }
      let j = i; while (j < c.y.length && c.y[j] === c.y[j]) j++;
      found.push([i, j]); i = j;
    }
    return found;
  }
  drawBand(g, c) {
    g.fillStyle = c.colour + "2b";
    for (const [i, j] of this.runs(c)) {
      g.beginPath();
      for (let k = i; k < j; k++) g.lineTo(this.x(k), this.y(c.y[k] + (c.half[k] || 0)));
      for (let k = j - 1; k >= i; k--) g.lineTo(this.x(k), this.y(c.y[k] - (c.half[k] || 0)));
      g.fill();
    }
  }
  drawLine(g, c) {
    g.strokeStyle = c.colour; g.lineWidth = 1.6; g.lineJoin = "round";
    // Between two frames the line is dotted if the curve is not determined in one of them.
    const dotted = k => c.sure && !(c.sure[k] && c.sure[k + 1]);
    for (const [first, end] of this.runs(c)) {
      for (let i = first; i < end - 1;) {
        let j = i + 1; while (j < end - 1 && dotted(j) === dotted(i)) j++;
        g.setLineDash(dotted(i) ? [2, 3] : []);
        g.beginPath();
        for (let k = i; k <= j; k++) g.lineTo(this.x(k), this.y(c.y[k]));
        g.stroke();
        i = j;
      }
      if (end === first + 1) {
        g.beginPath(); g.lineTo(this.x(first), this.y(c.y[first])); g.lineTo(this.x(first) + 1, this.y(c.y[first])); g.stroke();
      }
    }
    g.setLineDash([]);
  }
  drawMarks(g) {
    const first = this.time[0], span = this.time[this.time.length - 1] - first || 1;
    g.lineWidth = 1.3;
    for (const mark of this.options.marks || []) {
      const x = this.x((mark.at - first) / span * (this.time.length - 1));
      g.strokeStyle = mark.colour; g.setLineDash(mark.dotted ? [1.5, 3] : [6, 4]);
      g.beginPath(); g.moveTo(x, MARGIN.top); g.lineTo(x, this.height - MARGIN.bottom); g.stroke();
    }
    g.setLineDash([]);
  }
  update() {
    if (!this.width) return;
    const at = this.own === null ? current : this.own;
    this.line.style.left = this.x(at) + "px";
    this.read.textContent = "";
    // Where many curves lie over each other only the last ones, drawn on top, are read out.
    for (const c of this.curves.slice(-Math.min(this.options.reads, this.curves.length))) {
      const v = c.y[at];
      if (v !== v) continue;
      const part = document.createElement("span");
      part.style.color = c.colour;
      const half = c.half[at];
      const text = readable(v, this.options.digits) + (half > 0 ? " ± " + half.toFixed(this.options.digits) : "") + this.options.unit;
      part.textContent = "  " + (c.sure && !c.sure[at] ? `(${text})` : text);
      this.read.appendChild(part);
    }
  }
}

// A plot of curves that the page describes as a whole, over the time of the page or over an axis of its own.
function addPlot(parent, entry) {
  const axis = entry.axis ? floats(entry.axis) : null, n = axis ? axis.length : time.length;
  const curves = entry.curves.map(c => curve(floats(c.values), c.sd ? floats(c.sd) : null, 1, 0, c.label, c.colour, n));
  return new Plot(parent, entry.title, curves, { unit: entry.unit, least: entry.least, digits: entry.digits, time: axis, marks: entry.marks, reads: curves.length > 3 ? 1 : 3 });
}
