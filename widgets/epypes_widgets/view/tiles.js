// Tiles: the numbers of a run, written at the moment at which its picture appears.
import { button, element, keep, note, say } from "./elements.js";

const TILE_SIGNS = { fresh: "", stale: "~", failed: "!" };
const VERDICT_SIGNS = { passed: "✓", failed: "✗" };

/** The numbers that are pinned beside the picture, and a menu of the others. */
export function tilesPart(panel) {
  const menu = element("select", "epypes-input epypes-more-tiles", { "aria-label": "Pin a number", title: "Pin a number beside the picture" });
  const root = element("div", "epypes-tiles", { role: "group", "aria-label": "Numbers", hidden: "" }, menu);
  /** @type {Map<string, any>} by token */
  const tiles = new Map();
  let offered = [];
  let others = "";

  function make(token) {
    const [name, sign, value, change] = ["epypes-tile-name", "epypes-verdict-sign", "epypes-tile-value", "epypes-tile-change"].map((css) => element("span", css));
    const unpin = button("epypes-unpin", { "aria-label": `Unpin ${token}`, title: `Unpin ${token}` }, () => panel.send({ kind: "pin", token, on: false }), "×");
    const node = element("div", "epypes-tile", { "data-token": token, role: "group" }, name, sign, unpin, value, change);
    say(name, token);
    menu.before(node);
    return { node, sign, value, change };
  }

  function offer(pinned) {
    const left = offered.filter((token) => !pinned.includes(token));
    menu.hidden = left.length === 0;
    if (others === left.join("\n")) return;
    others = left.join("\n");
    menu.replaceChildren(element("option", "", { value: "" }, "+ number"), ...left.map((token) => element("option", "", { value: token }, token)));
  }

  menu.addEventListener("change", () => {
    panel.send({ kind: "pin", token: menu.value, on: true });
    menu.value = "";
  });

  return {
    element: root,
    /** What asks the kernel to compute. */
    asking: menu,
    setup({ numbers = [] }) {
      offered = numbers;
      offer([...tiles.keys()]);
      root.hidden = offered.length === 0;
    },
    /** The picture of a frame is on the screen from now on, and these are its numbers. */
    show({ seq, tiles: given = [] }) {
      keep(tiles, given.map(({ token }) => token), make);
      for (const { token, text, change, state, verdict, title } of given) {
        const tile = tiles.get(token);
        say(tile.value, text);
        say(tile.change, change);
        say(tile.sign, TILE_SIGNS[state] || (VERDICT_SIGNS[verdict] ?? ""));
        note(tile.node, "data-state", state);
        note(tile.node, "data-verdict", verdict);
        note(tile.node, "title", title);
        note(tile.node, "aria-label", title);
        // Of a vector; a tile keeps its width, so that no other moves.
        if (text.includes(", ")) tile.node.classList.add("epypes-wide");
      }
      root.dataset.seq = String(seq);
      offer([...tiles.keys()]);
    },
  };
}
