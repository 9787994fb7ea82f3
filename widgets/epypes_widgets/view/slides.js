// Where is a slider of ipywidgets while it is dragged?
//
// The slider itself tells the kernel when it is let go. What it passes on the way goes with the view's own messages.

/** Return the number that a slider means at a place: whole where it is, and no finer than its steps can tell. */
export function shownAt(row, place) {
  if (row.integer) return Math.round(place);
  return row.log ? Number(place.toPrecision(4)) : place;
}

/** Return the value of a slider's model at places of its handles. */
export function modelValue(row, handles) {
  const each = handles.map((place) => shownAt(row, row.log ? 10 ** place : place));
  return row.names.length > 1 ? each : each[0];
}

/**
 * Call back with the value of a slider's model while a pointer drags it, until the signal is aborted.
 * @param {any} target the element of noUiSlider
 * @param {any} row
 * @param {(value: any) => void} moved
 * @param {AbortSignal} signal
 */
export function followSlides(target, row, moved, signal) {
  const slider = target.noUiSlider;
  if (!slider || !row.model) return;
  slider.on("slide.epypes", (_texts, _handle, places) => moved(modelValue(row, places)));
  signal.addEventListener("abort", () => slider.off("slide.epypes"));
}
