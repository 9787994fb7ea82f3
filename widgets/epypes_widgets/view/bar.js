// What can be switched and asked for above the picture?
import { element, iconButton, note, say, textButton } from "./elements.js";
import { targetLabel } from "./compare.js";

const PERCENT = 100;

/** The toolbar: live, undo and redo, zoom, comparison, histogram, marks, probe, rectangle. */
export function barPart(panel, parts) {
  const { stage, compare, histogram, probe, roi } = parts;
  const live = element("button", "epypes-button epypes-worded epypes-live-switch", { type: "button", role: "switch", "aria-checked": "true", title: "Compute while values are moved" }, element("span", "epypes-lamp", { "aria-hidden": "true" }), "Live");
  const run = textButton("Run", () => panel.send({ kind: "run" }), "epypes-run", "Compute the values now");
  const undo = iconButton("undo", "Undo", () => panel.send({ kind: "undo" }), "epypes-undo");
  const redo = iconButton("redo", "Redo", () => panel.send({ kind: "redo" }), "epypes-redo");
  const reset = iconButton("reset", "Reset all to default", () => panel.send({ kind: "reset", names: [] }), "epypes-reset-all");
  const scale = element("button", "epypes-button epypes-worded epypes-scale", { type: "button", title: "Pixel for pixel (1)", "aria-label": "Pixel for pixel" }, "100 %");
  const select = element("select", "epypes-compare", { "aria-label": "Compare with", title: "Compare with" });
  const flip = iconButton("flip", "Flip to the other picture while held (f)", () => undefined, "epypes-flip");
  const wipe = iconButton("wipe", "Wipe between the two pictures (w)", () => compare.toggle("wipe"), "epypes-wipe");
  const side = iconButton("side", "Side by side (s)", () => compare.toggle("side"), "epypes-side-button");
  const bars = iconButton("histogram", "Histogram (h)", () => toggle(histogram), "epypes-histogram-button");
  const log = iconButton("log", "Logarithmic counts (l)", () => toggleLog(), "epypes-log-button");
  const marks = iconButton("marks", "Marks on the picture (o)", () => toggleMarks(), "epypes-marks-button");
  const probed = iconButton("probe", "Values of the pixel under the pointer (p: by keys)", () => toggle(probe), "epypes-probe-button");
  const draw = iconButton("roi", "Draw a rectangle (r)", () => toggle(roi), "epypes-roi-button");
  const group = (label, ...children) => element("span", "epypes-group", { role: "group", "aria-label": label }, ...children);
  const root = element(
    "div",
    "epypes-bar",
    { role: "toolbar", "aria-label": "Panel" },
    group("Computing", live, run),
    group("History", undo, redo, reset),
    group("Zoom", iconButton("minus", "Zoom out (-)", stage.zoomOut), scale, iconButton("plus", "Zoom in (+)", stage.zoomIn), iconButton("fit", "Fit (0)", stage.fit, "epypes-fit")),
    group("Compare", select, flip, wipe, side),
    group("Look", bars, log, marks, probed, draw),
  );
  let isLive = true;
  let isClosed = false;
  let areMarksOn = true;
  let stages = [];
  let entries = [];

  const press = (button, on) => note(button, "aria-pressed", String(Boolean(on)));

  function show() {
    press(wipe, compare.mode === "wipe");
    press(side, compare.mode === "side");
    press(flip, compare.isFlipped);
    press(bars, histogram.isOn);
    press(log, histogram.isLogarithmic);
    press(marks, areMarksOn);
    press(probed, probe.isOn);
    press(draw, roi.isDrawing);
    log.disabled = !histogram.isOn;
    draw.disabled = !roi.exists;
    live.disabled = reset.disabled = select.disabled = isClosed;
    run.disabled = isLive || isClosed;
    note(live, "aria-checked", String(isLive && !isClosed));
    choices();
  }

  function toggle(part) {
    part.toggle();
    show();
  }

  function toggleLog() {
    histogram.toggleLog();
    show();
  }

  function toggleMarks() {
    areMarksOn = !areMarksOn;
    stage.box.classList.toggle("epypes-without-marks", !areMarksOn);
    show();
  }

  function toggleProbe() {
    probe.toggleCross();
    show();
  }

  function choices() {
    const targets = [null, { kind: "default" }, ...stages.map((token) => ({ kind: "stage", token })), ...entries.map((number) => ({ kind: "history", number }))];
    if (compare.target && !targets.some((one) => targetLabel(one) === targetLabel(compare.target))) targets.push(compare.target);
    const key = JSON.stringify(targets);
    if (select.dataset.key !== key) {
      select.dataset.key = key;
      select.replaceChildren(
        ...targets.map((target) => element("option", "", { value: JSON.stringify(target) }, target ? `with ${targetLabel(target)}` : "Compare…")),
      );
    }
    select.value = JSON.stringify(compare.target);
  }

  live.addEventListener("click", () => {
    isLive = !isLive;
    panel.send({ kind: "live", on: isLive });
    show();
  });
  scale.addEventListener("click", stage.actualSize);
  select.addEventListener("change", () => compare.choose(JSON.parse(select.value)));
  // A button that works while it is held, by the pointer or by a key.
  flip.addEventListener("pointerdown", () => compare.flip(true));
  flip.addEventListener("keydown", (event) => [" ", "Enter"].includes(event.key) && compare.flip(true));
  for (const end of ["pointerup", "pointercancel", "pointerleave", "keyup", "blur"]) flip.addEventListener(end, () => compare.flip(false));
  compare.watch(show);
  roi.watch(show);
  histogram.watch(show);
  let scheduled = false;
  stage.watch(() => {
    if (scheduled) return;
    scheduled = true;
    setTimeout(() => {
      scheduled = false;
      say(scale, `${Math.round(stage.place.scale * PERCENT)} %`);
    });
  });

  function history(message) {
    undo.disabled = !message.undo || isClosed;
    redo.disabled = !message.redo || isClosed;
    const numbers = message.entries ?? (Array.isArray(message.history) ? message.history : message.history?.entries);
    if (numbers) entries = numbers.map(({ number }) => number);
    show();
  }

  return {
    element: root,
    setup(message) {
      isLive = message.live;
      isClosed = Boolean(message.closed);
      stages = message.stages.filter(({ is_picture }) => is_picture).map(({ token }) => token);
      history(message);
    },
    history,
    toggle: { histogram: () => toggle(histogram), log: toggleLog, marks: toggleMarks, probe: toggleProbe, roi: () => toggle(roi) },
  };
}
