// Exploring the pictures of graphs on a page, without a kernel.
//
// Hovering or focusing a vertex shows its thumbnail larger and what is known of it; choosing one (click, Enter, Space)
// marks its ancestors and descendants and tells of it below the picture; Escape ends both. All listeners are the
// figure's, so nothing outlives it. Where the script stands says nothing: VS Code runs it at the end of the output, and
// a notebook may run it again.
(() => {
  const VERTEX = "[id^=function-],[id^=token-]";
  const OWN_KEYS = "data-lm-suppress-shortcuts";
  const LARGER = 3, GAP = 10;

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

  // Pages that do not trust a notebook keep images only, so the picture comes as one.
  function inlined(image) {
    const text = decodeURIComponent(image.getAttribute("src").replace(/^[^,]*,/, ""));
    const svg = new DOMParser().parseFromString(text, "image/svg+xml").documentElement;
    if (svg.tagName !== "svg") return null;
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
    if (svg && data) explore(figure, svg, JSON.parse(data.textContent));
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
    (figure.querySelector("figcaption") ?? figure.lastChild).after(about, card);
    const dock = docked(about, figure);
    const placeOf = (target) => vertices.indexOf(target?.closest?.(VERTEX));
    let near = -1, chosen = -1, frame = 0;

    function show(place) {
      if (place === near) return;
      near = place;
      if (place >= 0) card.replaceChildren(...enlarged(vertices[place]), ...facts(labels[place]));
      card.classList.toggle("open", place >= 0);
      if (card.isConnected) card.togglePopover?.(place >= 0);
      cancelAnimationFrame(frame);
      if (place >= 0) follow();
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
      about.replaceChildren(...(chosen < 0 ? [] : story(labels[chosen], data, chosen, functions.length)));
      dock();
      if (chosen >= 0) openInside(figure, data.groups?.[chosen]);
    }

    figure.addEventListener("pointerover", (event) => show(placeOf(event.target)));
    figure.addEventListener("pointerleave", () => show(-1));
    figure.addEventListener("focusin", (event) => event.target.matches(":focus-visible") && show(placeOf(event.target)));
    figure.addEventListener("focusout", () => show(-1));
    svg.addEventListener("click", (event) => {
      const place = placeOf(event.target);
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

  // Below a large picture nobody would see the panel: then it stands at the lower edge of the window, while the figure
  // is to be seen. Gives a function that is called when what is in the panel has changed.
  function docked(panel, figure) {
    if (!panel.togglePopover) return () => {};
    const watch = new IntersectionObserver(([entry]) => {
      if (panel.isConnected && panel.hasAttribute("popover")) panel.togglePopover(entry.isIntersecting);
    });
    return () => {
      watch.disconnect();
      panel.removeAttribute("popover");
      if (!panel.firstChild || panel.getBoundingClientRect().bottom <= innerHeight) return;
      const at = figure.getBoundingClientRect();
      panel.style.left = `${Math.max(GAP, at.left)}px`;
      panel.style.width = `${Math.min(at.width, innerWidth - 2 * GAP)}px`;
      panel.setAttribute("popover", "manual");
      watch.observe(figure);
    };
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

  // The same picture or chart once more, not a second one: a browser keeps one copy of what it has decoded.
  function enlarged(vertex) {
    const shown = vertex.querySelector("image,.chart");
    if (!shown) return [];
    const svg = draw("svg", "epypes-graph"), box = shown.getBBox();
    svg.setAttribute("viewBox", [box.x - 1, box.y - 1, box.width + 2, box.height + 2].join(" "));
    svg.setAttribute("width", (box.width + 2) * LARGER);
    svg.setAttribute("height", (box.height + 2) * LARGER);
    svg.append(shown.cloneNode(true));
    return [svg];
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
    for (const inside of group === undefined ? [] : figure.parentElement.querySelectorAll("details.epypes-inside"))
      if (inside.dataset.group === group) {
        inside.open = true;
        inside.scrollIntoView({ block: "nearest" });
      }
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
