// The page's own life: which plots there are, the frame that all of them show, and the replay's clock.
"use strict";

const CAMERA_COLOURS = ["#2f5d8a", "#b5651d", "#3b7d4f", "#8a3b6b", "#6b6b1f", "#2f8a86", "#7a4fb0", "#a33a3a"];
const scene = makeReplay(byId("scene"), byId("scene-problem"), data);

function showFrame(frame, fromUser) {
  current = Math.max(0, Math.min(time.length - 1, frame));
  player.follow(STATE_NAMES[state[current]]);
  for (const plot of plots) plot.update();
  if (scene) scene.show(current);
  if (fromUser) player.stop();
}
const player = makePlayer();

function anglePlots() {
  const values = floats(data.angles.values), sd = floats(data.angles.sd), groups = new Map();
  const determined = data.angles.determined ? new Uint8Array(bytes(data.angles.determined)) : null;
  for (const entry of data.angles.plots) {
    const curves = entry.curves.map(c => Object.assign(curve(values, sd, data.angles.count, c.index, c.label, c.colour), {
      sure: determined && Uint8Array.from(time, (_, i) => determined[i * data.angles.count + c.index]) }));
    const plot = new Plot(byId("angle-plots"), entry.title, curves, {});
    if (!groups.has(entry.group)) groups.set(entry.group, []);
    groups.get(entry.group).push(plot);
  }
  const buttons = ["all", ...groups.keys()].map(name => {
    const button = document.createElement("button");
    button.type = "button"; button.textContent = name; button.setAttribute("aria-pressed", name === "all");
    button.addEventListener("click", () => {
      for (const other of buttons) other.setAttribute("aria-pressed", other === button);
      for (const [group, members] of groups) for (const plot of members) {
        plot.figure.hidden = name !== "all" && name !== group;
        plot.figure.style.display = plot.figure.hidden ? "none" : "";
        plot.draw();
      }
    });
    byId("angle-groups").appendChild(button);
    return button;
  });
}

function agreementPlot() {
  const values = floats(data.cameras.agreement), names = data.cameras.names;
  const curves = names.map((name, i) => curve(values, null, names.length, i, name, CAMERA_COLOURS[i % CAMERA_COLOURS.length]));
  const least = values.reduce((low, v) => v < low ? v : low, 0.8);
  const title = new Plot(byId("agreement-plots"), "", curves, { range: [Math.max(0, least - 0.03), 1], digits: 2, unit: "" }).figure.querySelector("span");
  for (const c of curves) {
    const part = document.createElement("span");
    part.style.color = c.colour; part.style.marginRight = "16px"; part.textContent = c.label;
    title.appendChild(part);
  }
}

function jointPlots() {
  const centres = floats(data.joints.centres), sd = floats(data.joints.sd), count = 3 * data.joints.names.length;
  const made = ["X", "Y", "Z"].map(axis => new Plot(byId("joint-plots"), axis, [], { least: 0.05, digits: 3, unit: " m" }));
  const choose = () => {
    const joint = Number(byId("joint").value);
    made.forEach((plot, axis) => {
      plot.curves = [curve(centres, sd, count, 3 * joint + axis, "XYZ"[axis], data.joints.colours[joint])];
      plot.range = valueRange(plot.curves, 0.05);
      plot.draw();
    });
  };
  byId("joint").addEventListener("change", choose);
  choose();
}

anglePlots(); agreementPlot(); jointPlots();
if (data.cycle) for (const entry of data.cycle.plots) addPlot(byId("cycle-plots"), entry);
if (scene) {
  data.replay.cameras.forEach((camera, i) => byId("eye").add(new Option(camera.name, i)));
  byId("eye").addEventListener("change", event => scene.lookFrom(Number(event.target.value)));
  for (const what of ["surface", "bones", "trails"]) byId("show-" + what).addEventListener("change", event => scene.toggle(what, event.target.checked));
}
const drawAll = () => { for (const plot of plots) plot.draw(); if (scene) scene.show(current); };
window.addEventListener("resize", drawAll);
drawAll();
// report.html#frame=120 opens at that frame.
const linked = /frame=(\d+)/.exec(location.hash);
const firstSeen = Math.max(0, state.findIndex(s => s === 1));
showFrame(linked ? Math.round(Number(linked[1]) / data.stride) : firstSeen, false);
