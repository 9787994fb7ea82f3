// View controls: contrast limits, colour map, opacity over another image, and how the picture is enlarged.
import { button, element, note, shape } from "./elements.js";
import { shortly, written } from "./numbers.js";
import { questions } from "./protocol.js";

/** Seventeen colours of each, from black to white; the browser interpolates between them. */
const COLOUR_MAPS = {
  gray: "",
  inverted: "ffffff000000",
  viridis: "44015448186a472d7b4240863b528b33638d2c728e26828e21918c1fa08828ae803fbc735ec96284d44baddc30d8e219fde725",
  inferno: "0000040b0724210c4a3d096557106e71196e8a226aa32c61bc3754d24644e45a31f1731df98e09fcac11f9cb35f2ea69fcffa4",
  turbo: "30123b4040a2466be34294ff28bceb18ddc232f2986dfe62a4fc3ccdec34eecf3afdac34fb7e21eb500ed02f05a916017a0403",
  coolwarm: "3b4cc04e68d86282ea779af78db0fea3c2feb9d0f9ccd9eddddcdcecd3c5f5c4acf7b093f4987aeb7d62dd5f4bca3b37b40426",
};
/** Over another image what is black is clear; a mask is yellow, labels keep their colours. */
const CLEAR_GROUNDS = { mask: "0 0 0 0 1  0 0 0 0 0.88  0 0 0 0 0.29  1 0 0 0 0", labels: "1 0 0 0 0  0 1 0 0 0  0 0 1 0 0  3 3 3 0 0" };
const ZOOMS = ["auto", "nearest", "smooth"];
const AT_FIRST = { colour_map: "gray", over: "", opacity: 0.6, zoom: "auto" };
const MOST_STEPS = 1000;
const MOST_WHOLE_STEPS = 4096;

/** Return one channel (0 to 2) of colours in hexadecimal, as the table of a filter. */
export function channelTable(colours, channel) {
  const each = colours.match(/.{6}/g) ?? [];
  return each.map((colour) => Number((Number.parseInt(colour.slice(2 * channel, 2 * channel + 2), 16) / 255).toFixed(4))).join(" ");
}

/** Return limits with one of them (0: black, 1: white) moved to a value, still below or above the other by a step. */
export function moved([low, high], index, value, step) {
  return index ? [low, Math.max(value, low + step)] : [Math.min(value, high - step), high];
}

/** Return the ends and the step of the sliders of a picture's limits: what was typed may lie beyond its range. */
export function sliderOf({ range, limits, dtype }) {
  const [low, high] = [Math.min(range[0], limits[0]), Math.max(range[1], limits[1])];
  const isWhole = /int/.test(dtype) && high - low <= MOST_WHOLE_STEPS;
  return { low, high, step: isWhole ? 1 : (high - low) / MOST_STEPS };
}

/** Return a limit as the box shows it: whole, or as many digits as fit. */
const limitText = (value) => written(Number.isInteger(value) ? value : Number(value.toPrecision(5)));

let views = 0;

/** Controls in a row above the picture. */
export function picturesPart(panel, stage) {
  const prefix = `epypes-filter-${(views += 1)}`;
  /** @type {Map<string, any>} by the token of the image */
  let settings = new Map();
  /** What was dressed last: the picture of each image element, and whether it lies over another one. */
  const dressed = new Map();
  let main = null;
  let isOn = false;
  let hasNumbers = false;
  let last = 0;
  const asked = questions((question, id) => {
    last = id;
    panel.send({ kind: "picture", ...question });
  });
  const settingsOf = (token) => settings.get(token) ?? AT_FIRST;

  function filter(name, ...content) {
    return shape("filter", { id: `${prefix}-${name}`, x: 0, y: 0, width: 1, height: 1, "color-interpolation-filters": "sRGB" }, ...content);
  }

  function mapped([name, colours]) {
    const channels = [...("RGB")].map((channel, at) => shape(`feFunc${channel}`, { type: "table", tableValues: channelTable(colours, at) }));
    return filter(name, shape("feComponentTransfer", {}, ...channels));
  }

  const filters = shape(
    "svg",
    { class: "epypes-filters", width: 0, height: 0, "aria-hidden": "true" },
    ...Object.entries(COLOUR_MAPS).filter(([, colours]) => colours).map(mapped),
    ...Object.entries(CLEAR_GROUNDS).map(([kind, values]) => filter(kind, shape("feColorMatrix", { values }))),
  );

  function labelled(text, ...nodes) {
    return element("label", "epypes-look-label", {}, text, ...nodes);
  }

  function choice(name, title, options) {
    const node = element("select", "epypes-compare", { "data-name": name, title });
    offer(node, options);
    node.addEventListener("change", () => set({ [name]: node.value }));
    return node;
  }

  function offer(node, options) {
    node.replaceChildren(...options.map((value) => element("option", "", { value }, value || "nothing")));
  }

  const ends = ["black", "white"].map((name, index) => {
    const slider = element("input", "epypes-limit", { type: "range", "data-name": name, "aria-label": `Value shown ${name}` });
    const box = element("input", "epypes-input epypes-limit-box", { type: "text", inputmode: "decimal", "aria-label": `Value shown ${name}` });
    slider.addEventListener("input", () => limit(index, Number(slider.value)));
    box.addEventListener("change", () => {
      const value = Number(box.value);
      if (box.value.trim() && Number.isFinite(value)) limit(index, value);
      box.value = limitText(main.limits[index]);
    });
    for (const node of [slider, box]) node.addEventListener("blur", refresh);
    return { slider, box, label: labelled(name, slider, box) };
  });
  const asking = (text, limits, title) => button("epypes-button epypes-worded", { title }, () => set({ limits }), text);
  const contrast = element(
    "span", "epypes-group epypes-contrast", { role: "group", "aria-label": "Contrast" }, ...ends.map((end) => end.label),
    asking("Auto", "auto", "From the darkest to the brightest value of this picture, but for 0.35 % at each end"),
    asking("Reset", null, "The whole range again"),
  );
  const colours = choice("colour_map", "Colour map", Object.keys(COLOUR_MAPS));
  const over = choice("over", "The image of the same size under this one", []);
  const opacity = element("input", "epypes-opacity", { type: "range", min: 0, max: 1, step: 0.05, "aria-label": "Opacity" });
  opacity.addEventListener("input", () => keepSet({ opacity: Number(opacity.value) }));
  opacity.addEventListener("change", () => set({ opacity: Number(opacity.value) }));
  const zoom = choice("zoom", "How the picture is enlarged: pixels as squares (nearest), smooth, or squares from 300 % on (auto)", ZOOMS);
  const [coloured, lying, opaque] = [labelled("colours", colours), labelled("over", over), labelled("opacity", opacity)];
  const numbers = element("div", "epypes-numbers", { hidden: "", role: "group", "aria-label": "Numbers of this picture" });
  stage.pane.append(numbers);
  const root = element("div", "epypes-look", { role: "group", "aria-label": "View", hidden: "" }, contrast, coloured, lying, opaque, labelled("zoom", zoom), filters);

  function keepSet(change) {
    settings.set(main.image, { ...settingsOf(main.image), ...change });
    for (const [img, given] of dressed) dress(img, ...given);
    refresh();
  }

  function set(change) {
    if (!main) return;
    keepSet(change);
    panel.send({ kind: "picture", token: main.image, change });
  }

  /** The kernel draws it anew: the next limits go out when the picture with these is there. */
  function limit(index, value) {
    main.limits = moved(main.limits, index, value, sliderOf(main).step);
    asked.ask({ token: main.image, change: { limits: main.limits } });
    refresh();
  }

  function refresh() {
    const isPhotograph = main?.kind === "photograph";
    contrast.hidden = !isPhotograph;
    coloured.hidden = !isPhotograph || Boolean(main.order);
    lying.hidden = !main?.beneath;
    if (!main) return;
    const given = settingsOf(main.image);
    opaque.hidden = lying.hidden || !given.over;
    const tokens = ["", ...(main.beneath ?? [])];
    if (over.dataset.tokens !== tokens.join("\n")) {
      over.dataset.tokens = tokens.join("\n");
      offer(over, tokens);
    }
    [colours.value, over.value, zoom.value, opacity.value] = [given.colour_map, given.over, given.zoom, given.opacity];
    const { low, high, step } = sliderOf(main);
    ends.forEach(({ slider, box }, index) => {
      for (const [name, value] of Object.entries({ min: low, max: high, step })) note(slider, name, value);
      // What the user holds is the user's.
      if (document.activeElement !== slider) slider.value = main.limits[index];
      if (document.activeElement !== box) box.value = limitText(main.limits[index]);
      note(slider, "title", shortly(main.limits[index]));
    });
    note(stage.box, "data-zoom", given.zoom);
  }

  /** Show an image element as the settings of its token say; `isOver`: another image lies under it. */
  function dress(img, picture, isOver = false) {
    dressed.set(img, [picture, isOver]);
    const given = settingsOf(picture.image);
    const isMapped = picture.kind === "photograph" && !picture.order && COLOUR_MAPS[given.colour_map];
    const name = isOver ? picture.kind : isMapped ? given.colour_map : "";
    img.style.filter = name ? `url("#${prefix}-${name}")` : "";
    img.style.opacity = isOver ? given.opacity : "";
    img.style.background = isOver ? "none" : "";
  }

  return {
    element: root,
    dress,
    setup(message) {
      settings = new Map(Object.entries(message.pictures ?? {}));
      hasNumbers = Boolean(message.scalars);
      for (const [img, given] of dressed) dress(img, ...given);
      refresh();
      panel.refresh();
    },
    frame({ frame, main: picture }) {
      const each = hasNumbers ? (frame.scalars ?? []) : [];
      numbers.hidden = each.length === 0;
      numbers.replaceChildren(...each.flatMap(({ token, text }) => [element("span", "", {}, token), element("b", "", {}, text)]));
      asked.answer(last);
      main = picture.image ? picture : null;
      refresh();
    },
    toggle() {
      isOn = !isOn;
      root.hidden = !isOn;
    },
    toggleNumbers() {
      hasNumbers = !hasNumbers;
      if (!hasNumbers) numbers.hidden = true;
      panel.send({ kind: "scalars", on: hasNumbers });
    },
    get isOn() { return isOn; },
    get hasNumbers() { return hasNumbers; },
  };
}
