// Which small pictures stand below the big one: pinned stages, test images, and the past?
import { element, note, say } from "./elements.js";

function thumbnail(label) {
  return element("img", "epypes-thumbnail", { alt: label, draggable: "false" });
}

function moveAlong(root) {
  root.addEventListener("keydown", (event) => {
    const all = [...root.querySelectorAll("button")];
    const at = all.indexOf(document.activeElement);
    const next = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: all.length - 1 }[event.key];
    if (at < 0 || next === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    all[Math.max(0, Math.min(next, all.length - 1))]?.focus();
  });
}

/** The stages that are kept in sight, each as a small picture that is clicked to be shown. */
export function pinnedPart(panel) {
  const root = element("div", "epypes-strip epypes-pinned", { role: "group", "aria-label": "Pinned stages", hidden: "" });
  const shownBy = new Map();
  moveAlong(root);

  function make(token) {
    const img = thumbnail(token);
    const text = element("span", "epypes-small-text");
    const button = element("button", "epypes-small", { type: "button", "data-token": token, title: `Show ${token}` }, img, text, element("span", "epypes-caption", {}, token));
    button.addEventListener("click", () => panel.chooseStage(token));
    root.append(button);
    return { img, text, button };
  }

  return {
    element: root,
    frame({ frame, shown }) {
      const pinned = shown.filter(({ picture }) => picture.role === "pinned");
      const tokens = new Set(pinned.map(({ picture }) => picture.token));
      for (const [token, parts] of shownBy) {
        if (tokens.has(token)) continue;
        panel.blobs.drop([parts.img]);
        parts.button.remove();
        shownBy.delete(token);
      }
      for (const { picture, bytes } of pinned) {
        if (!shownBy.has(picture.token)) shownBy.set(picture.token, make(picture.token));
        const { img, text, button } = shownBy.get(picture.token);
        const isText = picture.media_type === "text/plain";
        img.hidden = isText;
        text.hidden = !isText;
        if (isText) say(text, picture.text ?? "");
        else panel.blobs.fill(img, bytes, picture.media_type);
        note(button, "aria-current", String(picture.token === frame.token));
      }
      root.hidden = pinned.length === 0;
    },
  };
}

const VERDICTS = { passed: "✓ pass", failed: "✗ fail", waiting: "… waits" };

function tallied(verdicts) {
  if (verdicts.some(({ state }) => state === "failed")) return "failed";
  return verdicts.some(({ state }) => state === "waiting") ? "waiting" : "passed";
}

/** The test images that the graph can be tuned on. */
export function filmsPart(panel) {
  const root = element("div", "epypes-strip epypes-filmstrip", { role: "group", "aria-label": "Test images", hidden: "" });
  const tally = element("p", "epypes-tally", { role: "status", hidden: "" });
  let films = [];
  let verdicts = [];
  moveAlong(root);

  function choose(chosen) {
    for (const { index, button } of films) note(button, "aria-current", String(index === chosen));
  }

  /** Said by sign and word, since not everybody tells their colours apart. */
  function judge() {
    for (const { index, title, button, badge } of films) {
      const verdict = verdicts[index];
      badge.hidden = !verdict;
      if (!verdict) continue;
      note(badge, "data-state", verdict.state);
      say(badge, VERDICTS[verdict.state]);
      const said = `${title}: ${verdict.state === "waiting" ? "" : `${verdict.state}, `}${verdict.text}`;
      note(button, "title", said);
      note(button, "aria-label", said);
    }
  }

  return {
    element: root,
    tally,
    cases(message) {
      verdicts = message.verdicts;
      say(tally, message.text);
      note(tally, "data-state", tallied(verdicts));
      tally.hidden = false;
      judge();
    },
    setup(message, buffers) {
      const images = message.images ?? [];
      panel.blobs.drop(films.map(({ img }) => img));
      films = images.map(({ index, title }, at) => {
        const img = thumbnail(title);
        panel.blobs.fill(img, buffers[at]);
        const button = element("button", "epypes-small", { type: "button", title }, img, element("span", "epypes-caption", {}, title));
        const badge = element("span", "epypes-verdict", { hidden: "" });
        button.append(badge);
        button.addEventListener("click", () => {
          choose(index);
          panel.send({ kind: "image", index });
        });
        return { index, title, button, img, badge };
      });
      root.replaceChildren(...films.map(({ button }) => button));
      judge();
      root.hidden = images.length === 0;
    },
    frame: ({ frame }) => choose(frame.image),
  };
}

/** The settings that were committed, oldest first. */
export function historyPart(panel) {
  const list = element("div", "epypes-strip epypes-entries");
  const empty = element("span", "epypes-empty-strip", {}, "Nothing has been changed yet.");
  const root = element("div", "epypes-history", { role: "group", "aria-label": "History" }, list);
  /** By number of its entry; the kernel sends a thumbnail once. */
  const images = new Map();
  moveAlong(root);

  function make(entry, bytes) {
    const img = images.get(entry.number) ?? thumbnail("");
    const label = entry.label || `#${entry.number}`;
    const said = entry.changed || "start";
    const button = element(
      "button",
      "epypes-small epypes-entry",
      { type: "button", "data-number": String(entry.number), "aria-label": `Go to ${label}: ${said}`, title: `${label}: ${said}`, "aria-current": String(Boolean(entry.current)) },
      img,
      element("span", "epypes-caption", {}, element("b", "", {}, label), ` ${said}`),
    );
    button.addEventListener("click", () => panel.send({ kind: "goto", number: entry.number }));
    images.set(entry.number, img);
    if (bytes?.byteLength) panel.blobs.fill(img, bytes);
    img.hidden = !img.src;
    return button;
  }

  function forget(entries) {
    const numbers = new Set(entries.map(({ number }) => number));
    for (const [number, img] of images) {
      if (numbers.has(number)) continue;
      panel.blobs.drop([img]);
      images.delete(number);
    }
  }

  return {
    element: root,
    history(message, buffers) {
      const { entries } = message;
      const focused = document.activeElement?.closest?.(".epypes-entry")?.dataset.number;
      const buttons = entries.map((entry, at) => make(entry, buffers[at]));
      forget(entries);
      list.replaceChildren(...(buttons.length ? buttons : [empty]));
      if (focused !== undefined) buttons.find((one) => one.dataset.number === focused)?.focus();
      // Only this strip is scrolled, never the page.
      const current = buttons.find((one) => one.getAttribute("aria-current") === "true");
      if (current) list.scrollLeft = current.offsetLeft - (list.clientWidth - current.offsetWidth) / 2;
    },
  };
}
