// The stages as tabs: which is shown, which are pinned, and the state of each.
import { button, element, icon, note, say, walkAlong } from "./elements.js";

const STATES = {
  fresh: ["", ""],
  stale: ["stale", "~"],
  failed: ["failed", "!"],
  absent: ["not computed", "○"],
  nothing: ["nothing found", "∅"],
};

/** A tab for every token that can be looked at; each picture with a pin. */
export function chipsPart(panel) {
  const root = element("div", "epypes-chips", { role: "tablist", "aria-label": "Stages" });
  /** @type {Map<string, any>} by token */
  const chips = new Map();
  let pinned = new Set();
  let tiles = [];

  function make({ token, is_picture }, numbers) {
    const sign = element("span", "epypes-sign", { "aria-hidden": "true" });
    const kind = is_picture ? "epypes-chip" : "epypes-chip epypes-as-text";
    const chip = button(kind, { role: "tab", "data-token": token, tabindex: "-1", "aria-selected": "false" }, () => panel.chooseStage(token), token, sign);
    const pin = button("epypes-pin", { "aria-pressed": "false", tabindex: "-1" }, () => toggle(token), icon("pin"));
    const both = element("span", "epypes-chip-box", { role: "presentation" }, chip, is_picture || numbers.includes(token) ? pin : null);
    chips.set(token, { chip, pin, sign, both });
    return both;
  }

  function toggle(token) {
    const on = !pinned.delete(token);
    if (on) pinned.add(token);
    showPins();
    panel.send({ kind: "pin", token, on });
  }

  function select(token) {
    const reached = chips.has(token) ? token : chips.keys().next().value;
    for (const [name, { chip, pin, both }] of chips) {
      note(chip, "aria-selected", name === token);
      for (const button of [chip, pin]) note(button, "tabindex", name === reached ? 0 : -1);
      both.classList.toggle("epypes-chosen", name === token);
    }
  }

  function showPins() {
    for (const [token, { pin }] of chips) {
      const label = pinned.has(token) ? `Unpin ${token}` : `Pin ${token}: keep it computed and in sight`;
      note(pin, "aria-pressed", pinned.has(token));
      note(pin, "aria-label", label);
      note(pin, "title", label);
    }
  }

  function mark(states) {
    for (const [token, { chip, both, sign }] of chips) {
      const state = states?.[token] ?? "fresh";
      const [text, drawn] = STATES[state];
      both.dataset.state = state;
      say(sign, drawn);
      note(chip, "title", text ? `${token}: ${text}` : token);
      note(chip, "aria-label", text ? `${token}, ${text}` : token);
    }
  }

  walkAlong(root, ".epypes-chip", (chip) => chip.click());

  return {
    element: root,
    setup({ stages, numbers = [], pinned: tokens, token }) {
      const given = JSON.stringify([stages, numbers]);
      if (root.dataset.given !== given) {
        root.dataset.given = given;
        const focused = document.activeElement?.closest?.(".epypes-chip")?.dataset.token;
        chips.clear();
        root.replaceChildren(...stages.map((stage) => make(stage, numbers)));
        chips.get(focused)?.chip.focus();
      }
      pinned = new Set([...tokens, ...tiles]);
      showPins();
      select(token);
    },
    frame({ frame }) {
      select(frame.token);
      mark(frame.stages);
      const now = (frame.tiles ?? []).map((tile) => tile.token);
      if (now.join() === tiles.join()) return;
      pinned = new Set([...[...pinned].filter((token) => !tiles.includes(token)), ...now]);
      tiles = now;
      showPins();
    },
    select,
  };
}
