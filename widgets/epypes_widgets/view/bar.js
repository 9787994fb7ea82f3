// The toolbar above the picture: live, undo and redo, zoom, comparison, histogram, marks, probe, rectangle; and its keys.
import { targetLabel } from "./compare.js";
import { ARROWS, consume, element, iconButton, note, say, textButton } from "./elements.js";

const TYPED_IN = "input, select, textarea";

export function barPart(panel, { stage, compare, pictures, histogram, probe, roi }) {
  const group = (label, ...children) => element("span", "epypes-group", { role: "group", "aria-label": label }, ...children);
  const asking = (icon, label, message, name) => iconButton(icon, label, () => panel.send(message), name);
  const escape = () => {
    roi.stop();
    if (probe.isCrossed) probe.toggleCross();
  };
  const keys = {
    "+": stage.zoomIn, "=": stage.zoomIn, "-": stage.zoomOut, 0: stage.fit, 1: stage.actualSize, f: () => compare.flip(true), p: () => probe.toggleCross(), escape,
  };
  /** What is on or off, by the buttons that show it. */
  const isOnOf = new Map();
  /** A button that is pressed while something is on; its key does the same as a click. */
  function toggling(icon, label, key, isOn, toggle, name) {
    const made = iconButton(icon, label, () => (toggle(), refresh()), name);
    isOnOf.set(made, isOn);
    if (key) keys[key] = toggle;
    return made;
  }
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
  isOnOf.set(flip, () => compare.isFlipped);
  const wipe = toggling("wipe", "Wipe between the two pictures (w)", "w", () => compare.mode === "wipe", () => compare.toggle("wipe"), "epypes-wipe");
  const side = toggling("side", "Side by side (s)", "s", () => compare.mode === "side", () => compare.toggle("side"), "epypes-side-button");
  const look = toggling("contrast", "Contrast, colours, what it lies over (c)", "c", () => pictures.isOn, () => pictures.toggle(), "epypes-look-button");
  const bars = toggling("histogram", "Histogram (h)", "h", () => histogram.isOn, () => histogram.toggle(), "epypes-histogram-button");
  const log = toggling("log", "Logarithmic counts (l)", "l", () => histogram.isLogarithmic, () => histogram.toggleLog());
  const hidden = "epypes-without-marks";
  const marks = toggling("marks", "Marks on the picture (o)", "o", () => !stage.box.classList.contains(hidden), () => stage.box.classList.toggle(hidden));
  const numbers = toggling("numbers", "Numbers of the picture on it (n)", "n", () => pictures.hasNumbers, () => pictures.toggleNumbers(), "epypes-numbers-button");
  const probed = toggling("probe", "Values of the pixel under the pointer (p: by keys)", "", () => probe.isOn, () => probe.toggle());
  const draw = toggling("roi", "Draw a rectangle (r)", "r", () => roi.isDrawing, () => roi.toggle(), "epypes-roi-button");
  const root = element(
    "div",
    "epypes-bar",
    { role: "toolbar", "aria-label": "Panel" },
    group("Computing", live, run),
    group("History", undo, redo, reset),
    group("Zoom", iconButton("minus", "Zoom out (-)", stage.zoomOut), scale, iconButton("plus", "Zoom in (+)", stage.zoomIn), iconButton("fit", "Fit (0)", stage.fit, "epypes-fit")),
    group("Compare", select, flip, wipe, side),
    group("Look", look, bars, log, marks, numbers, probed, draw),
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
    for (const [made, isOn] of isOnOf) note(made, "aria-pressed", isOn());
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
  stage.watch(() => say(scale, `${Math.round(stage.place.scale * 100)} %`));

  /** Do what a key means; return whether it means anything here. */
  function act(event) {
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey) {
      if (isTheirs(event)) return false;
      panel.send({ kind: key === "y" || event.shiftKey ? "redo" : "undo" });
    } else if (event.key in ARROWS) {
      if (event.target !== stage.box) return false;
      const [right, down] = ARROWS[event.key];
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
