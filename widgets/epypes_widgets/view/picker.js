// How is one tile of a contact sheet chosen with the mouse, or with the keyboard?

// Until JupyterLab has a thread for widgets beside that of the cells, a message waits for a cell that runs.
const FIRST_ANSWER_MS = 500;
const LAST_ANSWER_MS = 8000;
const TOWARDS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
// Straight on before aside.
const ASIDE = 4;

/**
 * @param {string} tag
 * @param {string} [name] its classes
 * @param {Record<string, string>} [attributes]
 * @param {...(Node | string)} children
 * @returns {any}
 */
function element(tag, name = "", attributes = {}, ...children) {
  const made = document.createElement(tag);
  if (name) made.className = name;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/** @param {{model: any, el: HTMLElement}} context given by anywidget */
function render({ model, el }) {
  const heading = element("div", "epypes-picker-heading");
  const sheet = element("div", "epypes-picker-sheet", { role: "group", "aria-label": "Settings" });
  const status = element("div", "epypes-picker-status", { role: "status" });
  const root = element("div", "epypes-picker", { "data-lm-suppress-shortcuts": "true" }, heading, sheet, status);
  el.append(root);
  let urls = [];
  let state = { chosen: null, busy: false, text: "" };
  let isTold = false;

  const tiles = () => [...sheet.querySelectorAll("button")];
  const send = (content) => model.send(content);

  function letGo() {
    urls.forEach((url) => URL.revokeObjectURL(url));
    urls = [];
  }

  function tile(told, pictures) {
    const what = `${told.setting}: ${told.failed ? `failed, ${told.text}` : told.text}`;
    const button = element("button", "epypes-picker-tile", { type: "button", "data-place": String(told.place), "aria-label": what, title: what });
    if (told.failed) {
      button.classList.add("epypes-picker-failed");
      button.append(element("span", "epypes-picker-text", {}, element("b", "", {}, "failed "), told.text));
    } else if (told.picture === null) button.append(element("span", "epypes-picker-text", {}, told.text));
    else button.append(element("img", "", { alt: "", draggable: "false", src: pictures[told.picture] }));
    if (told.label) button.append(element("span", "epypes-picker-label", {}, told.label));
    button.addEventListener("click", () => {
      settle(button);
      send({ kind: "pick", place: told.place });
    });
    return button;
  }

  function table(message, block, pictures) {
    const { rows, columns, row_labels: down, column_labels: across } = message;
    const made = element("table");
    if (block.title) made.append(element("caption", "", {}, block.title));
    const corner = () => (rows ? [element("td")] : []);
    if (columns) {
      made.append(element("tr", "", {}, ...corner(), element("th", "", { colspan: String(across.length), scope: "colgroup" }, columns)));
      const names = across.map((label) => element("th", "", { scope: "col" }, label));
      made.append(element("tr", "", {}, ...(rows ? [element("th", "epypes-picker-rows", { scope: "col" }, rows)] : []), ...names));
    } else made.append(element("tr", "", {}, element("th", "", { scope: "col" }, rows), element("td")));
    block.rows.forEach((row, at) => {
      const cells = row.map((cell) => element("td", "", {}, ...cell.map((told) => tile(told, pictures))));
      made.append(element("tr", "", {}, ...(rows ? [element("th", "", { scope: "row" }, down[at])] : []), ...cells));
    });
    return made;
  }

  function flow(block, pictures) {
    const all = block.rows.flat(2).map((told) => tile(told, pictures));
    const title = block.title ? [element("div", "epypes-picker-title", {}, block.title)] : [];
    return element("div", "", {}, ...title, element("div", "epypes-picker-flow", {}, ...all));
  }

  function tellSheet(message, buffers) {
    letGo();
    const media = {};
    message.blocks.forEach(({ rows }) => rows.flat(2).forEach(({ picture, media_type }) => (media[picture] = media_type)));
    urls = buffers.map((buffer, at) => URL.createObjectURL(new Blob([buffer], { type: media[at] })));
    const isTable = message.rows || message.columns;
    const blocks = message.blocks.map((block) => (isTable ? table(message, block, urls) : flow(block, urls)));
    const more = message.left_out ? [element("div", "epypes-picker-more", {}, `and ${message.left_out} more, for which there is no room here`)] : [];
    const focused = root.contains(document.activeElement) ? document.activeElement?.dataset?.place : undefined;
    sheet.replaceChildren(...blocks, ...more);
    tellTokens(message);
    tellState(state);
    if (focused !== undefined) sheet.querySelector(`[data-place="${focused}"]`)?.focus();
  }

  function tellTokens({ token, tokens }) {
    const choice = element("select", "", { "aria-label": "Token that is shown" });
    if (token === null) choice.append(element("option", "", { value: "", selected: "" }, "values"));
    for (const name of tokens) choice.append(element("option", "", name === token ? { value: name, selected: "" } : { value: name }, name));
    choice.addEventListener("change", () => send({ kind: "show", token: choice.value }));
    const hint = element("span", "epypes-picker-hint", {}, "Click a tile, or press Enter on it, to set the runner to it.");
    heading.replaceChildren(...(tokens.length ? [choice] : []), hint);
  }

  function tellState(told) {
    state = told;
    root.classList.toggle("epypes-picker-busy", Boolean(told.busy));
    for (const button of tiles()) button.setAttribute("aria-pressed", String(Number(button.dataset.place) === told.chosen));
    if (status.textContent !== told.text) status.textContent = told.text;
    if (!sheet.querySelector("button[tabindex='0']")) {
      const first = sheet.querySelector("button[aria-pressed='true']") ?? sheet.querySelector("button");
      if (first) settle(first, false);
    }
  }

  /** The one tile that Tab comes to. */
  function settle(button, isFocused = true) {
    for (const other of tiles()) other.tabIndex = other === button ? 0 : -1;
    if (isFocused) button.focus();
  }

  function neighbour(from, [right, down]) {
    const middle = (node) => {
      const box = node.getBoundingClientRect();
      return [box.x + box.width / 2, box.y + box.height / 2];
    };
    const [x, y] = middle(from);
    let found = null;
    let least = Infinity;
    for (const other of tiles()) {
      const [there, below] = middle(other);
      const ahead = (there - x) * right + (below - y) * down;
      const aside = Math.abs((there - x) * down) + Math.abs((below - y) * right);
      if (other === from || ahead < 2 || ahead + ASIDE * aside >= least) continue;
      least = ahead + ASIDE * aside;
      found = other;
    }
    return found;
  }

  function onKey(event) {
    const from = document.activeElement;
    if (!tiles().includes(from) || event.ctrlKey || event.metaKey || event.altKey) return;
    const all = tiles();
    const next = { Home: all[0], End: all.at(-1) }[event.key] ?? (TOWARDS[event.key] && neighbour(from, TOWARDS[event.key]));
    if (event.key in TOWARDS || next) event.preventDefault();
    event.stopPropagation();
    if (next) settle(next);
  }

  const handlers = { sheet: tellSheet, state: tellState };
  const onMessage = (message, buffers) => {
    if (message.kind === "sheet") {
      isTold = true;
      clearTimeout(knocking);
    }
    handlers[message.kind]?.(message, buffers ?? []);
  };

  let knocking = 0;
  function knock(answer_ms) {
    if (isTold) return;
    send({ kind: "ready" });
    knocking = setTimeout(() => knock(Math.min(2 * answer_ms, LAST_ANSWER_MS)), answer_ms);
  }

  let area = null;
  const hide = () => {
    area = el.closest(".jp-OutputArea");
    area?.classList.add("epypes-picker-live");
  };
  hide();
  const hiding = area ? 0 : setTimeout(hide);
  root.addEventListener("keydown", onKey);
  model.on("msg:custom", onMessage);
  knock(FIRST_ANSWER_MS);
  return () => {
    clearTimeout(knocking);
    clearTimeout(hiding);
    area?.classList.remove("epypes-picker-live");
    model.off("msg:custom", onMessage);
    letGo();
    root.remove();
  };
}

export default { render };
