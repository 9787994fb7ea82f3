// What does a kernel answer, when a test decides what and when?
import view from "/view.js";

const STAGES = ["image", "gray", "blurred", "edges", "n_edges"];
const FILTERS = { image: "none", gray: "grayscale(1)", blurred: "grayscale(1) blur(4px)", edges: "grayscale(1) contrast(4) invert(1)" };
const SIZE = { width: 512, height: 384 };
const DEFAULTS = { crop: [60, 40, 200, 160], blur_kernel: 5, sigma: 1.5, canny_lo: 70, canny_hi: 200, border: "REFLECT" };
const row = (css, names, kind, of, more) => ({
  css: `epypes-row-${css}`, names, kind, functions: [of], model: `model-${css}`, integer: false, odd: false, log: false,
  low: names.map(() => 0), high: names.map(() => 255), step: names.map(() => 1), unit: "", tip: "",
  default: names.map((name) => DEFAULTS[name]), value: names.map((name) => DEFAULTS[name]), ...more,
});
const ROWS = [
  row(0, ["crop"], "roi", "crop", { low: [null], high: [null], tip: "The part of the image that is looked at." }),
  row(1, ["blur_kernel"], "slider", "blur", { integer: true, odd: true, low: [1], high: [31], step: [2], unit: "px", tip: "Side of the kernel." }),
  row(2, ["sigma"], "log", "blur", { log: true, low: [0.1], high: [10], step: [0.05], tip: "Standard deviation." }),
  row(3, ["border"], "choice", "blur", { low: [null], high: [null], step: [null] }),
  row(4, ["canny_lo", "canny_hi"], "range", "canny", { integer: true, tip: "Thresholds of the gradient." }),
];
const FOLDERS = ["crop", "blur", "canny"].map((name, i) => ({ css: `epypes-folder-${i}`, functions: [name] }));

/** A widget's model as the widget manager gives it. */
function fakeModel(value, moved) {
  const listeners = new Set();
  return {
    get: () => value,
    on: (_, listener) => listeners.add(listener),
    off: (_, listener) => listeners.delete(listener),
    set(next, byHand = true) {
      if (JSON.stringify(next) === JSON.stringify(value)) return;
      value = next;
      for (const listener of listeners) listener();
      if (byHand) moved(next);
    },
    get count() { return listeners.size; },
  };
}

/** A slider that has the library's class names and moves a model. */
function slider(one, model) {
  const target = document.createElement("div");
  target.className = "noUi-target";
  const handles = one.names.map(() => {
    const handle = document.createElement("div");
    handle.className = "noUi-handle";
    handle.tabIndex = 0;
    handle.setAttribute("role", "slider");
    target.append(handle);
    return handle;
  });
  // While a pointer drags, the place is told to listeners alone; the model has it when the pointer is let go.
  let places = null;
  const listeners = new Map();
  target.noUiSlider = {
    on: (event, listener) => listeners.set(event, listener),
    off: (event) => listeners.delete(event),
  };
  const values = () => places ?? [model.get()].flat();
  const [low, high] = [one.low[0], one.high[0]];
  const show = () => handles.forEach((handle, i) => { handle.style.left = `${((values()[i] - low) / (high - low)) * 100}%`; });
  const put = (i, value) => {
    const next = [...values()];
    next[i] = one.odd ? 2 * Math.floor(value / 2) + 1 : one.integer ? Math.round(value) : value;
    return next;
  };
  const set = (next) => model.set(one.names.length > 1 ? next : next[0]);
  target.addEventListener("pointerdown", (event) => {
    const box = target.getBoundingClientRect();
    const at = (later) => low + Math.min(1, Math.max(0, (later.clientX - box.left) / box.width)) * (high - low);
    const i = handles.indexOf(event.target) < 0 ? 0 : handles.indexOf(event.target);
    event.stopPropagation();
    target.setPointerCapture(event.pointerId);
    const move = (later) => {
      places = put(i, at(later));
      show();
      for (const listener of listeners.values()) listener(places.map(String), i, places);
    };
    const end = () => {
      target.removeEventListener("pointermove", move);
      const last = places;
      places = null;
      if (last) set(last);
    };
    target.addEventListener("pointermove", move);
    target.addEventListener("lostpointercapture", end, { once: true });
  });
  handles.forEach((handle, i) => handle.addEventListener("keydown", (event) => {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (by) set(put(i, values()[i] + by * one.step[0]));
  }));
  model.on("change:value", show);
  show();
  return target;
}

function buildControls() {
  const column = document.querySelector(".epypes-controls");
  column.innerHTML = `<div class="epypes-filter"><input type="text" placeholder="Filter" aria-label="Filter"></div>`;
  for (const folder of FOLDERS) {
    const box = document.createElement("div");
    box.className = `epypes-folder ${folder.css}`;
    box.innerHTML = `<div class="epypes-heading"><div class="widget-html-content"><span class="epypes-name">${folder.functions[0]}</span><span class="epypes-time"></span></div></div>`;
    for (const one of ROWS.filter((each) => each.functions[0] === folder.functions[0])) {
      const node = document.createElement("div");
      node.className = `epypes-row ${one.css}`;
      node.innerHTML = `<div class="jupyter-widgets widget-inline-hbox"><label class="widget-label">${one.names.join(" ")}</label><div class="slider-container"></div></div>`;
      const place = node.querySelector(".slider-container");
      if (["slider", "log", "range"].includes(one.kind)) place.append(slider(one, kernel.models[one.model]));
      else if (one.kind === "choice") place.innerHTML = `<select class="plain" aria-label="${one.names}"><option>REFLECT</option></select>`;
      box.append(node);
    }
    column.append(box);
  }
}

const photo = new Image();
photo.src = "/photo.jpg";
await photo.decode();
const drawn = new Map();

/** The bytes of a stage's picture; drawn once. */
async function bytesOf(token, width = SIZE.width) {
  const key = `${token} ${width}`;
  if (!drawn.has(key)) {
    const canvas = document.createElement("canvas");
    canvas.width = width;
    canvas.height = Math.round((width * SIZE.height) / SIZE.width);
    const context = canvas.getContext("2d");
    context.filter = FILTERS[token] ?? "none";
    context.drawImage(photo, 0, 0, canvas.width, canvas.height);
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/jpeg", 0.9));
    drawn.set(key, new DataView(await blob.arrayBuffer()));
  }
  return drawn.get(key);
}

const pictureOf = (token, role, width = SIZE.width) => ({
  token, role, media_type: "image/jpeg", width, height: Math.round((width * SIZE.height) / SIZE.width),
  full_width: SIZE.width, full_height: SIZE.height, shape: `${SIZE.height} x ${SIZE.width}`, dtype: "uint8", overlay: null,
});

function histogram(names = ["gray"]) {
  const bell = (middle, width) => Array.from({ length: 128 }, (_, i) => Math.round(4000 * Math.exp(-(((i - middle) / width) ** 2))));
  return { low: 0, high: 255, bins: 128, sampled: false, channels: names.map((name, i) => ({ name, counts: bell(40 + 25 * i, 18 + 6 * i) })) };
}

/** Everything that a test may look at or change. */
const kernel = {
  sent: [], values: structuredClone(DEFAULTS), token: "edges", pinned: [], seq: 0, isHistogramOn: false, compared: null, live: true,
  overlay: null, isQuiet: false, entries: [{ number: 0, values: {}, label: "#0", changed: "", current: true }], image: 0, video: null,
  defaults: DEFAULTS, bytesOf, pictureOf, histogram, size: SIZE,
  listeners: new Set(),
  models: {},
  kinds: (kind) => kernel.sent.filter((one) => one.kind === kind),
  deliver: (message, buffers = []) => kernel.listeners.forEach((listener) => listener(message, buffers)),
  /** A frame of the values as they are, ready to be delivered in any order. */
  async frame(changes = {}) {
    kernel.seq += 1;
    const isText = kernel.token === "n_edges";
    const main = isText
      ? { token: kernel.token, role: "main", media_type: "text/plain", text: "1843", width: 0, height: 0, full_width: 0, full_height: 0, shape: "", dtype: "", overlay: null }
      : { ...pictureOf(kernel.token, "main"), overlay: kernel.overlay };
    const message = {
      kind: "frame", seq: kernel.seq, token: kernel.token, values: structuredClone(kernel.values), compute_ms: 2.13, to_screen_ms: 31,
      times_ms: { crop: 0.2, blur: 1.1, canny: 0.8 }, ran: 3, reused: 1, stale: false, image: kernel.image, time_s: kernel.video && kernel.image / 25, pictures: [main],
      stages: Object.fromEntries(STAGES.map((token) => [token, "fresh"])),
      histogram: kernel.isHistogramOn && !isText ? histogram(kernel.token === "image" ? ["B", "G", "R"] : ["gray"]) : null,
      histograms: kernel.isHistogramOn ? { blurred: histogram() } : {},
    };
    const buffers = isText ? [] : [await bytesOf(kernel.token)];
    for (const token of kernel.pinned) {
      message.pictures.push(pictureOf(token, "pinned", 160));
      buffers.push(await bytesOf(token, 160));
    }
    if (kernel.compared?.kind === "stage") {
      message.pictures.push(pictureOf(kernel.compared.token, "other"));
      buffers.push(await bytesOf(kernel.compared.token));
    }
    return [{ ...message, ...changes }, buffers];
  },
  async run(changes) {
    kernel.deliver(...(await kernel.frame(changes)));
  },
  /** Resolves when the last frame has been acknowledged. */
  async painted(seq = kernel.seq) {
    while (!kernel.kinds("painted").some((one) => one.seq >= seq)) await new Promise((resolve) => setTimeout(resolve, 5));
  },
  async remember() {
    const buffers = await Promise.all(kernel.entries.map(() => bytesOf("edges", 96)));
    kernel.deliver({ kind: "history", entries: kernel.entries, undo: kernel.entries.length > 1, redo: false, code: `runner.rerun(canny_lo=${kernel.values.canny_lo})` }, buffers);
  },
  fail(text, of, names) {
    kernel.seq += 1;
    kernel.deliver({ kind: "error", seq: kernel.seq, text, function: of, names });
  },
};
/** What was moved and not committed, as it was sent: by itself, or with an acknowledgement. */
kernel.moves = () => kernel.sent.map((message) => (message.kind === "move" ? message : message.move)).filter(Boolean);
kernel.rows = ROWS;
window.kernel = kernel;

function moved(one, value) {
  one.names.forEach((name, i) => { kernel.values[name] = one.names.length > 1 ? value[i] : value; });
  if (!kernel.isQuiet) kernel.run();
}

for (const one of ROWS) {
  const value = one.names.length > 1 ? one.value : one.value[0];
  kernel.models[one.model] = fakeModel(value, (next) => moved(one, next));
}

function setValues(values) {
  Object.assign(kernel.values, values);
  for (const one of ROWS) {
    if (one.kind === "roi") continue;
    const next = one.names.map((name) => kernel.values[name]);
    kernel.models[one.model].set(one.names.length > 1 ? next : next[0], false);
  }
}

const answers = {
  async ready() {
    const images = kernel.video ? [] : [{ index: 0, title: "coffee" }, { index: 1, title: "coins" }];
    kernel.deliver({
      kind: "setup", rows: structuredClone(ROWS), folders: FOLDERS, stages: STAGES.map((token) => ({ token, is_picture: token !== "n_edges" })), images,
      video: kernel.video, live: kernel.live, cuts: [{ token: "blurred", names: ["canny_lo", "canny_hi"] }], rois: [{ name: "crop", token: "image" }],
      promote_to: "services/edges", settings: ["good", "dark"], token: kernel.token, pinned: [], closed: false,
    }, [await bytesOf("image", 96), await bytesOf("gray", 96)]);
    await kernel.remember();
    await kernel.run();
  },
  painted({ move }) {
    if (move) answers.move(move);
  },
  async move({ values, places, image }) {
    kernel.image = image ?? kernel.image;
    const slid = Object.entries(places).map(([model, place]) => {
      const { names } = ROWS.find((row) => row.model === model);
      return Object.fromEntries(names.map((name, i) => [name, [place].flat()[i]]));
    });
    setValues(Object.assign({}, values, ...slid));
    await kernel.run();
  },
  async set({ values }) {
    const changed = Object.entries(values).map(([name, value]) => `${name} ${JSON.stringify(kernel.values[name])} -> ${JSON.stringify(value)}`);
    setValues(values);
    kernel.entries.forEach((entry) => { entry.current = false; });
    kernel.entries.push({ number: kernel.entries.length, values, label: `#${kernel.entries.length}`, changed: changed.join(", "), current: true });
    await kernel.remember();
    await kernel.run();
  },
  async reset({ names }) {
    setValues(Object.fromEntries((names.length ? names : Object.keys(DEFAULTS)).map((name) => [name, DEFAULTS[name]])));
    await kernel.run();
  },
  async stage({ token }) { kernel.token = token; await kernel.run(); },
  async pin({ token, on }) { kernel.pinned = on ? [...kernel.pinned, token] : kernel.pinned.filter((one) => one !== token); await kernel.run(); },
  async histogram({ on }) { kernel.isHistogramOn = on; await kernel.run(); },
  async image({ index }) { kernel.image = index; await kernel.run(); },
  async compare(message) {
    kernel.compared = message.with;
    if (message.with?.kind === "stage") return kernel.run();
    if (!message.with) return undefined;
    kernel.seq += 1;
    return kernel.deliver({ kind: "reference", seq: kernel.seq, label: message.with.kind === "default" ? "default" : `#${message.with.number}`, picture: pictureOf("gray", "main") }, [await bytesOf("gray")]);
  },
  probe({ id, x, y }) {
    kernel.deliver({ kind: "probe", id, x, y, rows: STAGES.slice(0, 4).map((token) => ({ token, text: token === "image" ? "B 12 G 40 R 200" : String((x + y) % 256), state: "fresh" })) });
  },
  save({ name }) { kernel.deliver({ kind: "settings", names: ["good", "dark", name], text: `saved ${name}.toml`, ok: true }); },
  load({ name }) { kernel.deliver({ kind: "settings", names: ["good", "dark"], text: `There are no settings ${name}.`, ok: false }); },
  promote({ to }) {
    kernel.deliver({ kind: "promoted", state: "running", text: "", to });
    setTimeout(() => kernel.deliver({ kind: "promoted", state: "done", text: `3 functions written to ${to}; replayed, same values`, to }), 30);
  },
};

const model = {
  send(content) {
    kernel.sent.push(structuredClone(content));
    if (!kernel.isQuiet) setTimeout(() => answers[content.kind]?.(content));
  },
  on: (event, listener) => event === "msg:custom" && kernel.listeners.add(listener),
  off: (_, listener) => kernel.listeners.delete(listener),
  get: () => undefined,
  widget_manager: { get_model: async (id) => kernel.models[id] },
};
kernel.mount = () => { kernel.close = view.render({ model, el: document.getElementById("view") }); };
kernel.mount();
setTimeout(buildControls, 20);  // the rows come later than the view, as they may in a notebook
