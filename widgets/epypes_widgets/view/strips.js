// Below the big picture: pinned stages, test images or the slider of a video's frames, and the history.
import { button, element, fill, iconButton, keep, note, say, walkAlong } from "./elements.js";
import { FRAME } from "./protocol.js";

const ONE_CHANGE = /^(\S+) ([^,]+ -> [^,]+)$/;
const VERDICTS = { passed: "✓ pass", failed: "✗ fail", waiting: "… waits" };

function strip(name, label) {
  const root = element("div", `epypes-strip ${name}`, { role: "group", "aria-label": label });
  walkAlong(root, "button");
  return root;
}

/** A button with a small picture and a caption. */
function small(attributes, press, ...caption) {
  const img = element("img", "epypes-thumbnail", { alt: "", draggable: "false" });
  const text = element("span", "epypes-small-text", { hidden: "" });
  const node = button("epypes-small", attributes, press, img, text, element("span", "epypes-caption", {}, ...caption));
  return { img, text, node };
}

/** The stages that are kept in sight; a click shows one. */
export function pinnedPart(panel) {
  const root = strip("epypes-pinned", "Pinned stages");
  const parts = new Map();
  root.hidden = true;

  function make(token) {
    const made = small({ "data-token": token, title: `Show ${token}` }, () => panel.chooseStage(token), token);
    root.append(made.node);
    return made;
  }

  return {
    element: root,
    frame({ frame, shown }) {
      const pinned = shown.filter(({ picture }) => picture.role === "pinned");
      keep(parts, pinned.map(({ picture }) => picture.token), make);
      for (const { picture, bytes } of pinned) {
        const { img, text, node } = parts.get(picture.token);
        text.hidden = Boolean(bytes);
        img.hidden = !bytes;
        say(text, picture.text ?? "");
        fill(img, bytes, picture.media_type);
        note(node, "aria-current", picture.token === frame.token);
      }
      root.hidden = pinned.length === 0;
    },
  };
}

/** The test images that the graph can be tuned on. */
export function filmsPart(panel) {
  const root = strip("epypes-filmstrip", "Test images");
  const tally = element("p", "epypes-tally", { role: "status", hidden: "" });
  let films = [];
  let verdicts = [];

  function choose(chosen) {
    for (const { index, node } of films) note(node, "aria-current", index === chosen);
  }

  /** By sign and text, since not everybody can tell their colours apart. */
  function judge() {
    for (const { index, title, node, badge } of films) {
      const verdict = verdicts[index];
      badge.hidden = !verdict;
      if (!verdict) continue;
      note(badge, "data-state", verdict.state);
      say(badge, VERDICTS[verdict.state]);
      const label = `${title}: ${verdict.state === "waiting" ? "" : `${verdict.state}, `}${verdict.text}`;
      for (const name of ["title", "aria-label"]) note(node, name, label);
    }
  }

  function make({ index, title }, bytes) {
    const { img, node } = small({ title }, () => {
      choose(index);
      panel.send({ kind: "image", index });
    }, title);
    fill(img, bytes);
    const badge = element("span", "epypes-verdict", { hidden: "" });
    node.append(badge);
    return { index, title, node, badge };
  }

  return {
    element: root,
    tally,
    cases(message) {
      verdicts = message.verdicts;
      say(tally, message.text);
      note(tally, "data-state", ["failed", "waiting"].find((state) => verdicts.some((one) => one.state === state)) ?? "passed");
      tally.hidden = false;
      judge();
    },
    setup({ images }, buffers) {
      films = images.map((image, at) => make(image, buffers[at]));
      root.replaceChildren(...films.map(({ node }) => node));
      root.hidden = images.length === 0;
      judge();
    },
    frame: ({ frame }) => choose(frame.image),
  };
}

/** The frames of a video or a sequence that the graph can be tuned on. */
export function videoPart(panel) {
  const slider = element("input", "epypes-frames", { type: "range", min: "0", step: "1", "aria-label": "Frame of the video" });
  const before = iconButton("before", "Frame before", () => go(slider.valueAsNumber - 1), "epypes-frame-before");
  const after = iconButton("after", "Next frame", () => go(slider.valueAsNumber + 1), "epypes-frame-after");
  const text = element("span", "epypes-frame-text");
  const root = element("div", "epypes-video", { role: "group", "aria-label": "Frames", hidden: "" }, before, slider, after, text);
  let frames = null;
  /** The index of the frame that was shown last, and its time. */
  let shown = { image: null, time_s: null };

  function go(index) {
    slider.value = index;
    panel.seek(slider.valueAsNumber);
    describe();
  }

  function describe() {
    const { start, step, count } = frames.numbers;
    const index = slider.valueAsNumber;
    const number = start + step * index;
    // No frame is shown while the payload is another one, as that of a cell.
    const isShown = shown.image === index;
    // A sequence has no times.
    const time = !isShown ? "…" : shown.time_s === null ? "" : `${shown.time_s.toFixed(3)} s`;
    say(text, `frame ${number} of ${frames.name || "the sequence"}${time && " · "}${time}`);
    note(text, "title", `${frames.name || "Sequence"}: ${count} frames`);
    note(slider, "aria-valuetext", `frame ${number}${time && ", "}${time}`);
    before.disabled = index <= 0;
    after.disabled = index >= count - 1;
  }

  slider.addEventListener("input", () => go(slider.valueAsNumber));
  // JupyterLab's notebook would take them for itself.
  slider.addEventListener("keydown", (event) => event.key.startsWith("Arrow") && event.stopPropagation());
  return {
    element: root,
    setup(message) {
      frames = message.frames ?? null;
      root.hidden = !frames;
      if (!frames) return;
      slider.max = frames.numbers.count - 1;
      note(slider, "aria-label", `Frame of the ${frames.name ? "video" : "sequence"}`);
      describe();
    },
    frame({ frame }) {
      if (!frames) return;
      shown = { image: frame.image, time_s: frame.time_s };
      if (frame.image !== null && panel.takes(FRAME, frame.image)) slider.value = frame.image;
      describe();
    },
  };
}

/** The settings that were committed, oldest first. */
export function historyPart(panel) {
  const list = strip("epypes-entries", "History");
  const root = element("div", "epypes-history", {}, list);
  /** By number of its entry; the kernel sends a thumbnail once. */
  let images = new Map();

  /** The name of a single change is cut rather than its values. */
  function caption(name, text) {
    const [, changed, values] = ONE_CHANGE.exec(text) ?? [];
    const title = element("b", "", {}, name);
    return changed ? [element("span", "epypes-name", {}, title, ` ${changed}`), ` ${values}`] : [title, ` ${text}`];
  }

  function make(entry, bytes) {
    const name = entry.label || `#${entry.number}`;
    const text = entry.changed || "start";
    const whole = `${name}: ${entry.about || text}`;
    const attributes = { "data-number": entry.number, "aria-label": `Go to ${whole}`, title: whole, "aria-current": Boolean(entry.current) };
    const { img, node } = small(attributes, () => panel.send({ kind: "goto", number: entry.number }), ...caption(name, text));
    const shown = images.get(entry.number) ?? img;
    img.replaceWith(shown);
    if (bytes?.byteLength) fill(shown, bytes);
    shown.hidden = !shown.src;
    node.classList.add("epypes-entry");
    return [entry.number, shown, node];
  }

  return {
    element: root,
    history({ entries }, buffers) {
      const focused = document.activeElement?.closest?.(".epypes-entry")?.dataset.number;
      const made = entries.map((entry, at) => make(entry, buffers[at]));
      images = new Map(made);
      const nodes = made.map(([, , node]) => node);
      list.replaceChildren(...nodes);
      nodes.find((one) => one.dataset.number === focused)?.focus();
      // Only this strip is scrolled, never the page.
      const current = list.querySelector("[aria-current=true]");
      if (current) list.scrollLeft = current.offsetLeft - (list.clientWidth - current.offsetWidth) / 2;
    },
  };
}
