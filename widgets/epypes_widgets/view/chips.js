// Which stages are there, which is shown, and which are pinned?
import { element, icon, note } from "./elements.js";

const SAID = { fresh: "", stale: "stale", failed: "failed", absent: "not computed" };
const SIGNS = { fresh: "", stale: "~", failed: "!", absent: "○" };

/** A tab for every token that can be looked at, each with a pin. */
export function chipsPart(panel) {
  const root = element("div", "epypes-chips", { role: "tablist", "aria-label": "Stages" });
  /** @type {Map<string, any>} by token */
  const chips = new Map();
  let shown = "";
  let pinned = new Set();

  function make(token) {
    const sign = element("span", "epypes-sign", { "aria-hidden": "true" });
    const chip = element("button", "epypes-chip", { type: "button", role: "tab", "data-token": token, tabindex: "-1", "aria-selected": "false" }, token, sign);
    const pin = element("button", "epypes-pin", { type: "button", "aria-pressed": "false", tabindex: "-1" }, icon("pin"));
    chip.addEventListener("click", () => panel.chooseStage(token));
    pin.addEventListener("click", () => {
      const on = !pinned.has(token);
      if (on) pinned.add(token);
      else pinned.delete(token);
      showPins();
      panel.send({ kind: "pin", token, on });
    });
    const both = element("span", "epypes-chip-box", { role: "presentation" }, chip);
    root.append(both);
    return { chip, pin, sign, both, state: "" };
  }

  /** What is a picture may show only when it has been computed. */
  function tellKind({ token, is_picture }) {
    const { chip, pin, both } = chips.get(token);
    chip.classList.toggle("epypes-as-text", !is_picture);
    if (is_picture && !pin.isConnected) both.append(pin);
  }

  function rebuild(tokens) {
    const focused = document.activeElement?.closest?.(".epypes-chip")?.dataset.token;
    root.replaceChildren();
    chips.clear();
    for (const token of tokens) chips.set(token, make(token));
    shown = "";
    if (focused) chips.get(focused)?.chip.focus();
  }

  function select(token) {
    if (token === shown && chips.get(token)?.chip.getAttribute("aria-selected") === "true") return;
    shown = token;
    for (const [name, { chip, pin, both }] of chips) {
      const isShown = name === token;
      note(chip, "aria-selected", String(isShown));
      note(chip, "tabindex", isShown ? "0" : "-1");
      note(pin, "tabindex", isShown ? "0" : "-1");
      both.classList.toggle("epypes-chosen", isShown);
    }
    if (!chips.has(token)) chips.values().next().value?.chip.setAttribute("tabindex", "0");
  }

  function showPins() {
    for (const [token, { pin, both }] of chips) {
      const isPinned = pinned.has(token);
      note(pin, "aria-pressed", String(isPinned));
      note(pin, "aria-label", isPinned ? `Unpin ${token}` : `Pin ${token}: keep it computed and in sight`);
      note(pin, "title", pin.getAttribute("aria-label"));
      both.classList.toggle("epypes-is-pinned", isPinned);
    }
  }

  function mark(states) {
    for (const [token, parts] of chips) {
      const state = states?.[token] ?? "fresh";
      if (state === parts.state) continue;
      parts.state = state;
      parts.both.dataset.state = state;
      parts.sign.textContent = SIGNS[state] ?? "";
      note(parts.chip, "title", SAID[state] ? `${token}: ${SAID[state]}` : token);
      note(parts.chip, "aria-label", SAID[state] ? `${token}, ${SAID[state]}` : token);
    }
  }

  root.addEventListener("keydown", (event) => {
    const list = [...chips.values()].map(({ chip }) => chip);
    const at = list.indexOf(document.activeElement);
    const last = list.length - 1;
    const next = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: last }[event.key];
    if (at < 0 || next === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    const chip = list[next < 0 ? last : next > last ? 0 : next];
    chip.focus();
    chip.click();
  });

  return {
    element: root,
    setup(message) {
      const names = message.stages.map(({ token }) => token);
      if (names.join("\n") !== [...chips.keys()].join("\n")) rebuild(names);
      message.stages.forEach(tellKind);
      pinned = new Set(message.pinned ?? []);
      showPins();
      select(message.token);
    },
    frame({ frame }) {
      select(frame.token);
      mark(frame.stages);
    },
    failure(failure) {
      if (failure?.stages) mark(failure.stages);
    },
    select,
  };
}
