// The toolbar above the picture: live, undo and redo, zoom, comparison, histogram, marks, probe, rectangle; and its keys.
import { targetLabel } from "./compare.js";
import { consume, element, iconButton, note, say, textButton } from "./elements.js";

const PERCENT = 100;
const TYPED_IN = "input, select, textarea";
const PANS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export function barPart(panel, { stage, compare, histogram, probe, roi }) {
  const group = (label, ...children) => element("span", "epypes-group", { role: "group", "aria-label": label }, ...children);
  const asking = (icon, label, message, name) => iconButton(icon, label, () => panel.send(message), name);
  const toggling = (icon, label, toggle, name) => iconButton(icon, label, () => (toggle(), refresh()), name);
  const toggle = {
    histogram: () => histogram.toggle(),
    log: () => histogram.toggleLog(),
    marks: () => stage.box.classList.toggle("epypes-without-marks"),
    cross: () => probe.toggleCross(),
    roi: () => roi.toggle(),
  };
  const live = textButton("Live", onLive, "epypes-live-switch", "Compute while values are moved");
  live.prepend(element("span", "epypes-lamp", { "aria-hidden": "true" }));
  live.setAttribute("role", "switch");
  const run = textButton("Run", () => panel.send({ kind: "run" }), "epypes-run", "Compute the values now");
  const undo = asking("undo", "Undo", { kind: "undo" }, "epypes-undo");
  const redo = asking("redo", "Redo", { kind: "redo" }, "epypes-redo");
  const reset = asking("reset", "Reset all to default", { kind: "reset", names: [] }, "epypes-reset-all");
  const scale = textButton("100 %", stage.actualSize, "epypes-scale", "Pixel for pixel (1)");
  const select = element("select", "epypes-compare", { "aria-label": "Compare with", title: "Compare with" });
  const flip = iconButton("flip", "Flip to the other picture while held (f)", () => undefined);
  const wipe = toggling("wipe", "Wipe between the two pictures (w)", () => compare.toggle("wipe"), "epypes-wipe");
  const side = toggling("side", "Side by side (s)", () => compare.toggle("side"), "epypes-side-button");
  const bars = toggling("histogram", "Histogram (h)", toggle.histogram, "epypes-histogram-button");
  const log = toggling("log", "Logarithmic counts (l)", toggle.log);
  const marks = toggling("marks", "Marks on the picture (o)", toggle.marks);
  const probed = toggling("probe", "Values of the pixel under the pointer (p: by keys)", () => probe.toggle());
  const draw = toggling("roi", "Draw a rectangle (r)", toggle.roi, "epypes-roi-button");
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
  let past = { undo: false, redo: false, entries: [] };
  let stages = [];

  function onLive() {
    isLive = !isLive;
    panel.send({ kind: "live", on: isLive });
    refresh();
  }

  function refresh() {
    const pressed = [
      [wipe, compare.mode === "wipe"], [side, compare.mode === "side"], [flip, compare.isFlipped], [bars, histogram.isOn],
      [log, histogram.isLogarithmic], [marks, !stage.box.matches(".epypes-without-marks")], [probed, probe.isOn], [draw, roi.isDrawing],
    ];
    for (const [button, on] of pressed) note(button, "aria-pressed", on);
    note(live, "aria-checked", isLive && !isClosed);
    log.disabled = !histogram.isOn;
    draw.disabled = !roi.exists;
    live.disabled = reset.disabled = select.disabled = isClosed;
    run.disabled = isLive || isClosed;
    undo.disabled = !past.undo || isClosed;
    redo.disabled = !past.redo || isClosed;
    offer();
  }

  function offer() {
    const targets = [
      null, { kind: "default" }, ...stages.map((token) => ({ kind: "stage", token })), ...past.entries.map(({ number }) => ({ kind: "history", number })),
    ];
    if (!targets.some((one) => targetLabel(one) === targetLabel(compare.target))) targets.push(compare.target);
    const key = JSON.stringify(targets);
    if (select.dataset.key !== key) {
      select.dataset.key = key;
      const label = (target) => (target ? `with ${targetLabel(target)}` : "Compare…");
      select.replaceChildren(...targets.map((target) => element("option", "", { value: JSON.stringify(target) }, label(target))));
    }
    select.value = JSON.stringify(compare.target);
  }

  select.addEventListener("change", () => compare.choose(JSON.parse(select.value)));
  // A button that works while it is held, by the pointer or by a key.
  flip.addEventListener("pointerdown", () => compare.flip(true));
  flip.addEventListener("keydown", (event) => [" ", "Enter"].includes(event.key) && compare.flip(true));
  for (const end of ["pointerup", "pointercancel", "pointerleave", "keyup", "blur"]) flip.addEventListener(end, () => compare.flip(false));
  stage.watch(() => say(scale, `${Math.round(stage.place.scale * PERCENT)} %`));

  const keys = {
    "+": stage.zoomIn, "=": stage.zoomIn, "-": stage.zoomOut, 0: stage.fit, 1: stage.actualSize,
    h: toggle.histogram, l: toggle.log, o: toggle.marks, p: toggle.cross, r: toggle.roi,
    w: () => compare.toggle("wipe"), s: () => compare.toggle("side"), f: () => compare.flip(true),
    escape() {
      roi.stop();
      if (probe.isCrossed) probe.toggleCross();
    },
  };

  /** Do what a key means; return whether it means anything here. */
  function act(event) {
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey) {
      if (isTheirs(event)) return false;
      panel.send({ kind: key === "y" || event.shiftKey ? "redo" : "undo" });
    } else if (event.key in PANS) {
      if (event.target !== stage.box) return false;
      const [right, down] = PANS[event.key];
      if (!(event.shiftKey && probe.moveCross(right, down, event.altKey))) stage.pan(right, down);
    } else {
      if (!keys[key] || event.altKey) return false;
      if (!event.repeat || "+-=".includes(key)) keys[key]();
      refresh();
    }
    return true;
  }

  /** JupyterLab's own shortcuts are left alone where no key of the view is meant: Ctrl+S still saves. */
  const isTheirs = (event) => (event.ctrlKey || event.metaKey) && !["z", "y"].includes(event.key.toLowerCase());

  return {
    element: root,
    refresh,
    /** Handle the keys of a figure until the signal; those of its sliders and lists have been handled below. */
    listen(figure, signal) {
      figure.addEventListener("keydown", (event) => {
        if (!event.defaultPrevented && !event.target.closest(TYPED_IN) && act(event)) consume(event);
      });
      const onEarly = (event) => figure.contains(event.target) && figure.toggleAttribute("data-lm-suppress-shortcuts", !isTheirs(event));
      const unflip = (event) => (event.type === "blur" || event.key.toLowerCase() === "f") && compare.flip(false);
      window.addEventListener("keydown", onEarly, { capture: true, signal });
      for (const end of ["keyup", "blur"]) window.addEventListener(end, unflip, { signal });
    },
    setup(message) {
      isLive = message.live;
      isClosed = message.closed;
      stages = message.stages.filter(({ is_picture }) => is_picture).map(({ token }) => token);
      refresh();
    },
    history(message) {
      past = message;
      refresh();
    },
  };
}
