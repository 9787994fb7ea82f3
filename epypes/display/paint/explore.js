// Exploring the pictures of graphs on a page.
//
// Hovering or focusing a vertex shows its picture and what is known of it; choosing one (click, Enter, Space) marks its
// ancestors and descendants and tells of it beside or below the graph; Escape ends both. The graph is fitted into the
// output, zoomed and dragged. A picture is the sharpest that there is: from the kernel of the run, else kept with the
// page, else the thumbnail in its own size. All listeners are the figure's, so nothing outlives it. Where the script
// stands says nothing: VS Code runs it at the end of the output, and a notebook may run it again.
(() => {
  const VERTEX = "[id^=function-],[id^=token-]";
  // What pictures are drawn with.
  const DRAWN = new Set(("svg style title desc defs g path rect ellipse circle line polyline polygon text tspan image " +
    "use marker pattern clipPath linearGradient stop").split(" "));
  const OWN_KEYS = "data-lm-suppress-shortcuts";
  const LARGER = 3, GAP = 10;
  // What a graph may take of the window's height; its text can't be read at a smaller scale than READABLE.
  const HIGHEST = 0.78, READABLE = 0.75, LEAST = 0.05, LARGEST = 4, STEP = 1.25;
  const SCROLL_BAR_PX = 12, DRAGGED_PX = 4;
  // In so wide an output what is told of a vertex has room beside the graph.
  const BESIDE_PX = 820;
  // After so long without a question a connection is closed: all that the kernel publishes comes over it, too.
  const IDLE_MS = 10_000;
  // Where the pointer was on the screen at the last click.
  let clicked = "";

  document.querySelectorAll("figure.epypes-figure:not([data-alive])").forEach(enliven);

  function make(tag, kind, text = "") {
    const made = document.createElement(tag);
    made.className = kind;
    made.textContent = text;
    return made;
  }

  function draw(tag, kind) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    made.setAttribute("class", kind);
    return made;
  }

  // Pages that do not trust a notebook keep images only, so the picture comes as one. It may be of such a notebook that
  // is open beside a trusted one: only what can't run or load anything is taken from it.
  function inlined(image) {
    const text = decodeURIComponent(image.getAttribute("src").replace(/^[^,]*,/, ""));
    const svg = new DOMParser().parseFromString(text, "image/svg+xml").documentElement;
    if (svg.tagName !== "svg") return null;
    for (const each of [svg, ...svg.querySelectorAll("*")]) {
      if (each.namespaceURI !== svg.namespaceURI || !DRAWN.has(each.localName)) each.remove();
      for (const { name, value } of [...each.attributes])
        if (/^on/i.test(name) || (/href$/i.test(name) && !/^(#|data:image\/)/i.test(value))) each.removeAttribute(name);
    }
    const shown = document.importNode(svg, true);
    shown.style.cssText = image.style.cssText;
    image.replaceWith(shown);
    return shown;
  }

  function enliven(figure) {
    figure.dataset.alive = "";
    figure.querySelector(".epypes-still")?.remove();
    const image = figure.querySelector("img");
    const svg = image && inlined(image);
    const data = figure.querySelector("script.epypes-data");
    if (svg) zoomable(figure, svg);
    if (svg && data) explore(figure, svg, JSON.parse(data.textContent));
  }

  // Fits the graph into the output: the whole of it if it can be read then, else as wide as the output.
  function zoomable(figure, svg) {
    const view = svg.parentElement, { width, height } = svg.viewBox.baseVal;
    const stage = make("div", "epypes-stage"), bar = make("div", "epypes-zoom");
    const wide = () => (figure.clientWidth - SCROLL_BAR_PX) / width, high = () => (HIGHEST * innerHeight) / height;
    const whole = () => Math.min(wide(), high(), 1);
    const readable = () => (whole() < READABLE ? Math.min(Math.max(wide(), READABLE), 1) : whole());
    let scale = 1, fit = readable, known = 0;

    // What is at the point (x, y) of the view stays there.
    function zoom(next, x = view.clientWidth / 2, y = view.clientHeight / 2) {
      const ratio = Math.min(Math.max(next, LEAST), LARGEST) / scale;
      const left = (view.scrollLeft + x) * ratio - x, top = (view.scrollTop + y) * ratio - y;
      scale *= ratio;
      Object.assign(svg.style, { width: `${width * scale}px`, height: `${height * scale}px` });
      view.style.overflowY = scale > high() ? "scroll" : "hidden";
      view.scrollTo(left, top);
      percent.textContent = `${Math.round(100 * scale)}%`;
      figure.classList.toggle("cut", scale > high() || scale > wide());
      figure.classList.toggle("calm", scale === 1 && !figure.classList.contains("cut"));
    }

    function zoomBy(ratio, x, y) {
      fit = null;
      zoom(scale * ratio, x, y);
    }

    function fitAs(how) {
      fit = how;
      if (figure.clientWidth) zoom(how(), 0, 0);
    }

    function button(text, title, act) {
      const made = Object.assign(make("button", "", text), { type: "button", title });
      made.setAttribute(OWN_KEYS, "true");
      made.addEventListener("click", act);
      bar.append(made);
      return made;
    }

    button("−", "Zoom out (Ctrl and wheel)", () => zoomBy(1 / STEP));
    const percent = button("", "As large as can be read", () => fitAs(readable));
    button("+", "Zoom in (Ctrl and wheel)", () => zoomBy(STEP));
    button("Fit", "Show the whole graph", () => fitAs(whole));
    svg.style.cssText = "max-width:none;min-width:0";
    view.classList.add("epypes-window");
    view.style.maxHeight = `${100 * HIGHEST}vh`;
    view.before(stage);
    stage.append(view, ...figure.querySelectorAll("figcaption"), bar);
    view.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      const at = view.getBoundingClientRect();
      zoomBy(Math.exp(-event.deltaY / 300), event.clientX - at.left, event.clientY - at.top);
    }, { passive: false });
    draggable(view);
    // In a closed group a figure has no width until it is opened.
    new ResizeObserver(() => {
      if (figure.clientWidth !== known && fit) fitAs(fit);
      known = figure.clientWidth;
      figure.classList.toggle("beside", known >= BESIDE_PX);
    }).observe(figure);
    fitAs(readable);
  }

  function draggable(view) {
    let from = null, isDragged = false;
    view.addEventListener("pointerdown", ({ button, pointerType, clientX, clientY }) => {
      isDragged = false;
      if (!button && pointerType !== "touch") from = { clientX, clientY, left: view.scrollLeft, top: view.scrollTop };
    });
    view.addEventListener("pointermove", (event) => {
      if (!(event.buttons & 1)) from = null;
      if (!from) return;
      const x = event.clientX - from.clientX, y = event.clientY - from.clientY;
      isDragged ||= Math.hypot(x, y) > DRAGGED_PX;
      if (!isDragged) return;
      view.setPointerCapture(event.pointerId);
      view.scrollTo(from.left - x, from.top - y);
    });
    view.addEventListener("click", (event) => isDragged && event.stopPropagation(), true);
  }

  function explore(figure, svg, data) {
    const functions = [...svg.querySelectorAll("[id^=function-]")];
    const vertices = [...functions, ...svg.querySelectorAll("[id^=token-]")];
    const labels = vertices.map(labelled);
    const edges = edgesOf(svg, data.io, functions.length);
    const way = draw("path", "way"), head = draw("path", "head");
    // In this order the Tab key goes through them: as the data flows.
    svg.append(way, head, ...flow(data.io, functions.length, vertices.length).map((place) => vertices[place]));
    const card = make("div", "epypes-card"), about = make("div", "epypes-about");
    card.setAttribute("popover", "manual");
    card.setAttribute("aria-hidden", "true");
    about.setAttribute("aria-live", "polite");
    figure.querySelector(".epypes-stage").after(about, card);
    const picture = pictures(figure.closest(".epypes-sheet"), data.images, functions.length);
    const placeOf = (target) => vertices.indexOf(target?.closest?.(VERTEX));
    let near = -1, chosen = -1, frame = 0;

    function show(place) {
      if (place === near) return;
      near = place;
      if (place >= 0) {
        const [image, ...note] = picture("card", place, vertices[place]);
        card.replaceChildren(...(image ? [image] : []), ...facts(labels[place]), ...note);
      }
      open(place >= 0);
    }

    function open(isOpen) {
      card.classList.toggle("open", isOpen);
      if (card.isConnected) card.togglePopover?.(isOpen);
      cancelAnimationFrame(frame);
      if (isOpen) follow();
    }

    // Whatever scrolls, the card stays beside its vertex; no listener is needed outside the figure.
    function follow() {
      if (!figure.isConnected) return show(-1);
      stand(card, vertices[near], figure);
      frame = requestAnimationFrame(follow);
    }

    function choose(place) {
      chosen = place === chosen ? -1 : place;
      const kin = chosen < 0 ? null : kinOf(chosen, edges);
      svg.classList.toggle("lit", kin !== null);
      vertices.forEach((vertex, index) => {
        vertex.classList.toggle("kin", Boolean(kin?.vertices.has(index)));
        vertex.classList.toggle("chosen", index === chosen);
        vertex.setAttribute("aria-pressed", String(index === chosen));
      });
      way.setAttribute("d", (kin?.edges ?? []).map((edge) => edge.line).join(""));
      head.setAttribute("d", (kin?.edges ?? []).map((edge) => edge.tip).join(""));
      about.replaceChildren();
      if (chosen < 0) return;
      about.append(...story(labels[chosen], data, chosen, functions.length), ...picture("about", chosen, vertices[chosen]));
      // The card would lie over it.
      open(false);
      if (openInside(figure, data.groups?.[chosen])) return;
      const view = svg.parentElement, at = vertices[chosen].getBoundingClientRect(), port = view.getBoundingClientRect();
      view.scrollBy(Math.max(0, at.right - port.left - view.clientWidth), Math.max(0, at.bottom - port.top - view.clientHeight));
      about.scrollIntoView({ block: "nearest" });
    }

    const at = (event) => `${event.screenX} ${event.screenY}`;

    // What comes under a pointer that rests, since the click has moved the page, is not looked at.
    figure.addEventListener("pointerover", (event) => at(event) !== clicked && show(placeOf(event.target)));
    figure.addEventListener("pointerleave", () => show(-1));
    figure.addEventListener("focusin", (event) => event.target.matches(":focus-visible") && show(placeOf(event.target)));
    figure.addEventListener("focusout", () => show(-1));
    svg.addEventListener("click", (event) => {
      const place = placeOf(event.target);
      clicked = at(event);
      if (place >= 0 || chosen >= 0) choose(place < 0 ? chosen : place);
    });
    figure.addEventListener("keydown", (event) => {
      const place = placeOf(event.target);
      if (event.key === "Escape") {
        show(-1);
        if (chosen >= 0) choose(chosen);
      } else if (place >= 0 && (event.key === "Enter" || event.key === " ")) {
        event.preventDefault();
        choose(place);
      }
    });
  }

  function flow(io, functions, count) {
    const order = new Set();
    io.forEach(([inputs, outputs], place) => {
      const at = (token) => functions + (token < 0 ? ~token : token);
      for (const each of [...inputs.map(at), place, ...outputs.map(at)]) order.add(each);
    });
    for (let place = 0; place < count; place++) order.add(place);
    return [...order];
  }

  // A title would show a second, slower card; what it says becomes the vertex's name. JupyterLab takes keys for its
  // own shortcuts (d d deletes a cell) unless the very element that has the focus forbids it.
  function labelled(vertex) {
    const title = vertex.querySelector("title");
    const label = title?.textContent ?? vertex.id;
    title?.remove();
    const marks = { "aria-label": label, "aria-pressed": "false", role: "button", tabindex: "0", [OWN_KEYS]: "true" };
    for (const [name, value] of Object.entries(marks)) vertex.setAttribute(name, value);
    return label;
  }

  // Edges are painted as few paths; the pieces of the path of those that a run uses stand in their order. Arrows to and
  // from what is around the graph are paths of their own.
  function edgesOf(svg, io, functions) {
    const edges = [];
    let live = 0;
    io.forEach(([inputs, outputs], place) => {
      for (const [tokens, isInput] of [[inputs, true], [outputs, false]])
        for (const token of tokens) {
          const other = functions + (token < 0 ? ~token : token);
          const ends = isInput ? [other, place] : [place, other];
          edges.push({ from: ends[0], to: ends[1], piece: token < 0 ? -1 : live++ });
        }
    });
    const pieces = (kind) => [...svg.querySelectorAll(`${kind}:not(.off,.around)`)]
      .map((path) => path.getAttribute("d").split(/(?=M)/)).find((found) => found.length === live) ?? [];
    const lines = pieces(".edge"), tips = pieces(".tip");
    for (const edge of edges) Object.assign(edge, { line: lines[edge.piece] ?? "", tip: tips[edge.piece] ?? "" });
    return edges;
  }

  function kinOf(start, edges) {
    const kin = { vertices: new Set([start]), edges: [] };
    for (const [near, far] of [["from", "to"], ["to", "from"]]) {
      const leaving = new Map(edges.map((edge) => [edge[near], []]));
      for (const edge of edges) leaving.get(edge[near]).push(edge);
      const reached = new Set([start]);
      for (const place of reached)
        for (const edge of leaving.get(place) ?? []) {
          kin.edges.push(edge);
          reached.add(edge[far]);
          kin.vertices.add(edge[far]);
        }
    }
    return kin;
  }

  // Returns what makes the picture of a vertex for a place, the card or the panel; ``names`` are those of the tokens
  // that have one.
  function pictures(sheet, names = {}, functions = 0) {
    const album = sheet?.querySelector(".epypes-album");
    const kept = new Map([...(album?.querySelectorAll("img") ?? [])].map((image) => [image.alt, image.src]));
    const kernel = kernelOf(sheet?.dataset.run), full = new Map(), wanted = new Map();
    let isAsking = false;
    if (album) album.hidden = true;

    // The kernel has one question at a time, and each place wants what it shows now.
    async function ask() {
      if (isAsking) return;
      isAsking = true;
      while (wanted.size) {
        const [place, [name, show]] = [...wanted].at(-1);
        wanted.delete(place);
        const found = full.get(name) ?? (await kernel(name));
        if (found) full.set(name, found);
        show(found);
      }
      isAsking = false;
    }

    return (place, number, vertex) => {
      wanted.delete(place);
      const chart = vertex.querySelector(".chart"), name = names[number - functions];
      if (chart) return [drawnLarger(chart)];
      if (name === undefined) return [];
      const image = make("img", ""), note = make("small", ""), isKept = kept.has(name);
      const less = `${isKept ? "a smaller picture was kept" : "no larger picture was kept"}: run the cell again`;
      const show = (found) => {
        image.src = found || kept.get(name) || vertex.querySelector("image").getAttribute("href");
        note.textContent = found ? "" : less;
      };
      image.alt = name;
      // A mask that is enlarged keeps its edges; one that is made smaller keeps its lines.
      image.addEventListener("load", () =>
        image.classList.toggle("large", image.src.startsWith("data:image/png") && image.naturalWidth < image.clientWidth));
      show(full.get(name));
      if (kernel && !full.has(name)) {
        note.textContent = "asking the kernel";
        wanted.set(place, [name, show]);
        ask();
      }
      return [image, note];
    };
  }

  // A chart is a drawing, sharp in any size.
  function drawnLarger(chart) {
    const svg = draw("svg", "epypes-graph"), box = chart.getBBox();
    svg.setAttribute("viewBox", [box.x - 1, box.y - 1, box.width + 2, box.height + 2].join(" "));
    svg.setAttribute("width", (box.width + 2) * LARGER);
    svg.setAttribute("height", (box.height + 2) * LARGER);
    svg.append(chart.cloneNode(true));
    return svg;
  }

  // Returns what asks a kernel for the picture of a token: a function that resolves to a data URI, or to nothing. Null
  // where no server of Jupyter's is behind the page. The address is "kernel/run". The request is one to execute nothing
  // and to evaluate an expression, so its answer comes over this connection alone.
  function kernelOf(address) {
    // Outputs of notebooks that are not trusted may have any id, but no scripts.
    const settings = document.querySelector("script#jupyter-config-data");
    if (!address || !settings) return null;
    const unique = () => `${Date.now().toString(36)}-${Math.random().toString(36).slice(2)}`;
    const [id, run] = address.split("/"), session = unique();
    const { baseUrl, wsUrl, token } = JSON.parse(settings.textContent);
    const url = new URL(`${(wsUrl || baseUrl).replace(/\/$/, "")}/api/kernels/${id}/channels`, location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.search = new URLSearchParams({ session_id: session, ...(token && { token }) });
    let socket = null, idle = 0;

    const opened = () => new Promise((resolve, reject) => {
      if (socket?.readyState === WebSocket.OPEN) return resolve();
      socket = new WebSocket(url);
      Object.assign(socket, { onopen: resolve, onclose: reject });
    });
    const answered = (msg_id) => new Promise((resolve, reject) => {
      socket.onclose = reject;
      socket.onmessage = ({ data }) => {
        // Most of what comes is for others.
        const message = typeof data === "string" && data.includes(msg_id) ? JSON.parse(data) : {};
        if (message.channel === "shell" && message.parent_header.msg_id === msg_id) resolve(message.content);
      };
    });
    return async (name) => {
      clearTimeout(idle);
      try {
        await opened();
        const asked = [run, name].map((each) => JSON.stringify(each));
        const content = {
          code: "", silent: true, store_history: false, allow_stdin: false, stop_on_error: false,
          user_expressions: { picture: `__import__("epypes.display").display.full_picture(${asked})` },
        };
        const header = { msg_id: unique(), session, msg_type: "execute_request", username: "", version: "5.3" };
        header.date = new Date().toISOString();
        socket.send(JSON.stringify({ channel: "shell", header, parent_header: {}, metadata: {}, content, buffers: [] }));
        return (await answered(header.msg_id)).user_expressions?.picture?.data?.["text/plain"];
      } catch {
        return undefined;
      } finally {
        idle = setTimeout(() => socket.close(), IDLE_MS);
      }
    };
  }

  function parts(label) {
    const end = label.indexOf(": ");
    return end < 0 ? [label, ""] : [label.slice(0, end), label.slice(end + 2)];
  }

  // Commas part what is known of a token, unless they are within brackets.
  function facts(label) {
    const [name, rest] = parts(label);
    const lines = rest.split(name.includes("token ") ? /, (?![^([{]*[)\]}])/ : /; /).filter(Boolean);
    return [make("b", "", name), ...lines.map((line) => make("div", "", line))];
  }

  function story(label, data, place, functions) {
    const [name, rest] = parts(label);
    const [signature, source] = (place < functions && data.texts[data.about[place]]) || ["", ""];
    const made = [make("b", "", name), ...(signature ? [make("code", "", signature)] : []), make("div", "", rest)];
    if (source) {
      made.push(make("pre", "", source));
      made.at(-1).tabIndex = 0;
      made.at(-1).setAttribute(OWN_KEYS, "true");
    } else if (data.about[place] === null) made.push(make("div", "", "source left out to keep the picture small"));
    return made;
  }

  function openInside(figure, group) {
    const insides = [...figure.parentElement.querySelectorAll("details.epypes-inside")];
    const inside = insides.find((each) => each.dataset.group === group);
    if (!inside) return false;
    inside.open = true;
    inside.scrollIntoView({ block: "nearest" });
    return true;
  }

  // In the top layer nothing clips the card; without popovers it stands in the figure.
  function stand(card, vertex, figure) {
    const at = vertex.getBoundingClientRect();
    const within = (value, most) => Math.max(GAP, Math.min(value, most - GAP));
    const right = at.right + GAP, fits = right + card.offsetWidth + GAP <= innerWidth;
    const left = within(fits ? right : at.left - GAP - card.offsetWidth, innerWidth - card.offsetWidth);
    const top = within(at.top + (at.height - card.offsetHeight) / 2, innerHeight - card.offsetHeight);
    const origin = card.togglePopover ? { left: 0, top: 0 } : figure.getBoundingClientRect();
    card.style.left = `${left - origin.left}px`;
    card.style.top = `${top - origin.top}px`;
  }
})();
