// A page of curves: groups of plots over time or over a cycle, and scatter plots of differences over means.
"use strict";

const followers = [];
function showFrame(frame, fromUser) {
  current = Math.max(0, Math.min(time.length - 1, frame));
  for (const plot of plots) plot.update();
  for (const follow of followers) follow(fromUser);
}

// Differences over means with the bias and the limits of agreement ([BlandAltman1986]).
class Scatter {
  constructor(parent, entry) {
    this.x = floats(entry.x); this.y = floats(entry.y); this.entry = entry;
    this.figure = document.createElement("figure"); this.figure.className = "plot";
    this.figure.innerHTML = "<figcaption><span></span><span class='read'></span></figcaption><canvas></canvas>";
    this.figure.querySelector("span").textContent = entry.title;
    this.figure.querySelector(".read").textContent = entry.read;
    this.canvas = this.figure.querySelector("canvas");
    parent.appendChild(this.figure);
    addSaving(this.figure, entry.title, () => [], () => csv(["mean", "difference"], [this.x, this.y]));
    plots.push(this);
  }
  update() {}
  draw() {
    const ratio = window.devicePixelRatio || 1, width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width) return;
    this.canvas.width = width * ratio; this.canvas.height = height * ratio;
    const g = plotBrush(this.canvas); g.scale(ratio, ratio);
    const { bias, low, high } = this.entry;
    const range = values => valueRange([{ y: values, half: new Float32Array(values.length) }], 1);
    const [xa, xb] = range(this.x), [ya, yb] = range([...this.y, low === null ? NaN : low, high === null ? NaN : high]);
    const px = v => MARGIN.left + (width - MARGIN.left - MARGIN.right) * (v - xa) / (xb - xa);
    const py = v => height - MARGIN.bottom - (height - MARGIN.top - MARGIN.bottom) * (v - ya) / (yb - ya);
    g.font = "11px system-ui, sans-serif"; g.lineWidth = 1; g.fillStyle = "#5b6570";
    const step = niceStep(yb - ya, 4), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    g.textAlign = "right"; g.textBaseline = "middle";
    for (let v = Math.ceil(ya / step) * step; v <= yb; v += step) {
      const y = Math.round(py(v)) + 0.5;
      g.strokeStyle = Math.abs(v) < step * 1e-6 ? "#aab3bc" : "#e3e7eb";
      g.beginPath(); g.moveTo(MARGIN.left, y); g.lineTo(width - MARGIN.right, y); g.stroke();
      g.fillText(readable(v, digits), MARGIN.left - 6, y);
    }
    const stride = niceStep(xb - xa, width / 80);
    g.textAlign = "center"; g.textBaseline = "top";
    for (let v = Math.ceil(xa / stride) * stride; v <= xb; v += stride) g.fillText(+v.toFixed(6), px(v), height - MARGIN.bottom + 5);
    g.fillStyle = this.entry.colour + "70";
    for (let i = 0; i < this.x.length; i++) if (this.y[i] === this.y[i]) {
      g.beginPath(); g.arc(px(this.x[i]), py(this.y[i]), 1.7, 0, 7); g.fill();
    }
    for (const [v, dash] of [[bias, []], [low, [5, 4]], [high, [5, 4]]]) {
      if (v !== v || v === null) continue;
      g.strokeStyle = "#1d232b"; g.setLineDash(dash); g.beginPath(); g.moveTo(MARGIN.left, py(v)); g.lineTo(width - MARGIN.right, py(v)); g.stroke();
    }
    g.setLineDash([]);
  }
}

data.groups.forEach((group, number) => {
  const parent = document.getElementById("group-" + number);
  if (group.plots.some(entry => entry.curves && entry.curves.length > 3)) parent.classList.add("large");
  for (const entry of group.plots) {
    if (entry.scatter) new Scatter(parent, entry); else addPlot(parent, entry);
  }
});
const drawAll = () => { for (const plot of plots) plot.draw(); };
window.addEventListener("resize", drawAll);
drawAll();
showFrame(0);
