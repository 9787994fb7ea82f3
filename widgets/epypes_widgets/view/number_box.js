// A box beside a slider, in which a number is typed or stepped.
import { element, note } from "./elements.js";
import { FAST, means, read, same, stepped, written } from "./numbers.js";

/** A box grows with what is in it from this many characters on. */
const FITTING = 7;
const NUMBER_KEYS = { ArrowUp: 1, ArrowDown: -1, PageUp: FAST, PageDown: -FAST };

/**
 * A number box for one value of a row. It shows where the slider is, and the exact value behind it at rest.
 * What is being typed is never overwritten.
 */
export function numberBox(panel, row, index) {
  const name = row.names[index];
  const label = `${name}${row.unit ? ` in ${row.unit}` : ""}`;
  const input = element("input", "epypes-number", { type: "text", inputmode: "decimal", autocomplete: "off", "aria-label": label, "data-name": name, title: row.tip });
  let position = row.value[index];
  let exact = position;
  let isTyping = false;
  let isNoticed = false;

  const values = () => row.names.map((one) => panel.state.values[one]);
  const current = () => (means(row, index, position, exact) ? exact : position);

  function show() {
    if (isTyping) return;
    const text = typeof current() === "number" ? written(current()) : "";
    if (input.value !== text) input.value = text;
    fit();
  }

  function fit() {
    input.style.width = input.value.length > FITTING ? `calc(${input.value.length}ch + 14px)` : "";
  }

  function complain(problem) {
    note(input, "aria-invalid", Boolean(problem));
    input.title = problem || row.tip;
    panel.tell(problem);
  }

  const isRefused = () => input.getAttribute("aria-invalid") === "true";

  function restore() {
    isTyping = false;
    if (isRefused()) complain("");
    show();
  }

  /** Say that the value is not the one that was typed, until the next one is taken. */
  function tellNotice(notice) {
    if (notice || isNoticed) panel.tell(notice);
    isNoticed = Boolean(notice);
  }

  function place(value, commit, notice = "") {
    restore();
    tellNotice(notice);
    position = exact = value;
    show();
    panel.change(name, value, commit);
  }

  /** Take what was typed; it stays, marked, if it can't be taken. */
  function commit() {
    if (!isTyping) return;
    const found = read(row, index, input.value, values());
    if ("problem" in found) complain(found.problem);
    else place(found.value, true, found.notice);
  }

  function onKey(event) {
    const count = NUMBER_KEYS[event.key] * (event.shiftKey ? FAST : 1);
    if (event.key === "Enter") {
      if (isTyping) commit();
      else panel.commit();
      if (!isRefused()) input.select();
    } else if (event.key === "Escape") restore();
    else if (count) {
      event.preventDefault();
      const typed = isTyping ? read(row, index, input.value, values()) : {};
      place(stepped(row, index, "value" in typed ? typed.value : current(), count, values()), false);
    } else return;
    event.stopPropagation();
  }

  input.addEventListener("input", () => {
    isTyping = true;
    fit();
  });
  input.addEventListener("change", commit);
  input.addEventListener("blur", () => {
    commit();
    panel.commit();
  });
  input.addEventListener("keydown", onKey);
  show();

  return {
    input,
    name,
    /** The slider was moved, by the user or by the kernel; what was typed and refused goes then. */
    moved(value) {
      if (same(value, position)) return;
      position = value;
      tellNotice("");
      if (isRefused()) restore();
      else show();
    },
    /** A run with this value completed. */
    ran(value) {
      exact = value;
      show();
    },
    get value() { return current(); },
  };
}
