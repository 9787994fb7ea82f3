// How is a number typed beside its slider?
import { element, note } from "./elements.js";
import { FAST, means, read, same, stepped, written } from "./numbers.js";

/**
 * A number box for one value of a row. It shows where the slider is, and the exact value behind it at rest.
 * What is being typed is never overwritten.
 */
export function numberBox(panel, row, index) {
  const name = row.names[index];
  const input = element("input", "epypes-number", {
    type: "number",
    inputmode: "decimal",
    step: row.log ? "any" : String(row.step?.[index] ?? (row.integer ? 1 : "any")),
    "aria-label": `${name}${row.unit ? ` in ${row.unit}` : ""}`,
    "data-name": name,
    title: row.tip ?? "",
  });
  if ((row.integer || row.odd) && typeof row.low?.[index] === "number") input.min = String(row.low[index]);
  if (row.log) input.classList.add("epypes-logarithmic");
  let position = row.value?.[index];
  let exact = position;
  let isTyping = false;

  const values = () => row.names.map((one) => panel.state.values[one]);
  const current = () => (means(row, index, position, exact) ? exact : position);

  function show() {
    if (isTyping) return;
    const text = typeof current() === "number" ? written(current()) : "";
    if (input.value !== text) input.value = text;
  }

  function complain(problem) {
    note(input, "aria-invalid", problem ? "true" : "false");
    input.title = problem || row.tip || "";
    panel.tell(problem);
  }

  function restore() {
    isTyping = false;
    if (input.getAttribute("aria-invalid") === "true") complain("");
    show();
  }

  /** Take what was typed; it stays, marked, if it can't be taken. */
  function commit() {
    if (!isTyping) return;
    const typed = input.validity.badInput ? "what was typed" : input.value;
    const found = read(row, index, typed, values());
    if ("problem" in found) return complain(found.problem);
    const value = found.value;
    restore();
    place(value);
    panel.set({ [name]: value }, true);
  }

  function place(value) {
    position = exact = value;
    panel.state.values[name] = value;
    show();
  }

  input.addEventListener("input", () => {
    isTyping = true;
  });
  input.addEventListener("change", commit);
  input.addEventListener("blur", () => {
    commit();
    panel.commit();
  });
  input.addEventListener("wheel", (event) => document.activeElement === input && event.preventDefault(), { passive: false });
  input.addEventListener("keydown", (event) => {
    const steps = { ArrowUp: 1, ArrowDown: -1, PageUp: FAST, PageDown: -FAST }[event.key];
    if (event.key === "Enter") {
      if (isTyping) commit();
      else panel.commit();
      if (input.getAttribute("aria-invalid") !== "true") input.select();
    } else if (event.key === "Escape") restore();
    else if (steps) {
      event.preventDefault();
      const typed = isTyping ? read(row, index, input.value, values()) : null;
      const from = typed && "value" in typed ? typed.value : current();
      restore();
      place(stepped(row, index, from, event.shiftKey ? steps * FAST : steps, values()));
      panel.set({ [name]: exact }, false);
    } else return;
    event.stopPropagation();
  });
  show();

  return {
    input,
    name,
    /** The slider was moved, by the hand or by the kernel. */
    moved(value) {
      if (same(value, position)) return;
      position = value;
      show();
    },
    /** A run with this value completed. */
    ran(value) {
      exact = value;
      show();
    },
    get value() { return current(); },
  };
}
