// What does a key do in the view?

const TYPED_IN = "input, select, textarea";
const PANS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** Handles the keys of a figure; those of its sliders and lists have been handled below, and don't come here. */
export function handleKeys(figure, { stage, compare, probe, roi, bar, send }) {
  const letters = {
    "+": stage.zoomIn, "=": stage.zoomIn, "-": stage.zoomOut, 0: stage.fit, 1: stage.actualSize,
    h: bar.toggle.histogram, l: bar.toggle.log, o: bar.toggle.marks, p: bar.toggle.probe, r: bar.toggle.roi,
    w: () => compare.toggle("wipe"), s: () => compare.toggle("side"),
  };

  function onArrow(event) {
    const [right, down] = PANS[event.key];
    if (event.target !== stage.box) return false;
    if (event.shiftKey && probe.moveCross(right, down, event.altKey)) return true;
    stage.pan(right, down);
    return true;
  }

  function onCommand(event) {
    const key = event.key.toLowerCase();
    if (key !== "z" && key !== "y") return false;
    send({ kind: key === "y" || event.shiftKey ? "redo" : "undo" });
    return true;
  }

  function handle(event) {
    if (event.ctrlKey || event.metaKey) return onCommand(event);
    if (event.key in PANS) return onArrow(event);
    if (event.key === "f" || event.key === "F") {
      compare.flip(true);
      return true;
    }
    if (event.key === "Escape") {
      roi.stop();
      if (probe.isCrossed) bar.toggle.probe();
      return true;
    }
    const action = letters[event.key.toLowerCase()];
    if (!action || event.altKey) return false;
    if (!event.repeat || "+-=".includes(event.key)) action();
    return true;
  }

  function onKey(event) {
    if (event.defaultPrevented || event.target.closest(TYPED_IN)) return;
    if (!handle(event)) return;
    event.preventDefault();
    event.stopPropagation();
  }

  // JupyterLab's own shortcuts are left alone where no key of the view is meant: Ctrl+S still saves.
  function onEarly(event) {
    const isTheirs = (event.ctrlKey || event.metaKey) && !["z", "y"].includes(event.key.toLowerCase());
    if (figure.contains(event.target)) figure.toggleAttribute("data-lm-suppress-shortcuts", !isTheirs);
  }

  const unflip = (event) => (event.type === "blur" || event.key.toLowerCase() === "f") && compare.flip(false);
  figure.addEventListener("keydown", onKey);
  window.addEventListener("keydown", onEarly, true);
  window.addEventListener("keyup", unflip);
  window.addEventListener("blur", unflip);
  return () => {
    window.removeEventListener("keydown", onEarly, true);
    window.removeEventListener("keyup", unflip);
    window.removeEventListener("blur", unflip);
  };
}
