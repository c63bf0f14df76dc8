"use strict";
// The page is whole without this script. With it, points say their values under the pointer, a click on the mean of
// a run opens its trace, figures are enlarged and zoomed, tables are sorted by a click on their heads, and tables and
// figures can be saved.

const tip = document.body.appendChild(document.createElement("div"));
tip.className = "tip";
tip.setAttribute("role", "status");
const NEAR = 18; // Pixels from a point at which its text is shown.

function button(text, label, action) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.setAttribute("aria-label", label);
  made.addEventListener("click", action);
  return made;
}

function save(content, type, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// ---------------------------------------------------------------- dialog

const dialog = document.body.appendChild(document.createElement("dialog"));
dialog.addEventListener("close", () => document.body.append(tip));

function open(title, note, ...content) {
  const head = document.createElement("h2"), words = document.createElement("p");
  head.textContent = title;
  words.textContent = note;
  words.className = "quiet";
  dialog.replaceChildren(button("Close", "Close", () => dialog.close()), head, ...content, words, tip);
  if (!dialog.open) dialog.showModal();
}

// The wheel zooms about the pointer, a drag moves the drawing, a double click shows the whole.
function zoomable(svg) {
  const whole = svg.getAttribute("viewBox").split(" ").map(Number);
  let view = [...whole], from = null;
  const set = (x, y, width) => {
    const height = width * whole[3] / whole[2];
    const inside = (at, size, k) => Math.max(whole[k], Math.min(at, whole[k] + whole[k + 2] - size));
    view = [inside(x, width, 0), inside(y, height, 1), width, height];
    svg.setAttribute("viewBox", view.join(" "));
  };
  const at = event => {
    const shown = svg.getBoundingClientRect();
    return [(event.clientX - shown.x) / shown.width, (event.clientY - shown.y) / shown.height];
  };
  svg.addEventListener("wheel", event => {
    event.preventDefault();
    const [u, v] = at(event), wanted = view[2] * 1.0015 ** event.deltaY;
    const width = Math.min(whole[2], Math.max(whole[2] / 40, wanted));
    const shrunk = 1 - width / view[2];
    set(view[0] + u * view[2] * shrunk, view[1] + v * view[3] * shrunk, width);
  }, { passive: false });
  svg.addEventListener("pointerdown", event => { from = [at(event), view]; });
  svg.addEventListener("pointermove", event => {
    if (from === null || !event.buttons) return;
    const [u, v] = at(event), [[a, b], start] = from;
    set(start[0] + (a - u) * start[2], start[1] + (b - v) * start[3], start[2]);
  });
  svg.addEventListener("pointerup", () => { from = null; });
  svg.addEventListener("dblclick", () => set(whole[0], whole[1], whole[2]));
  return svg;
}

// ---------------------------------------------------------------- trace of a run

const traces = JSON.parse(document.getElementById("runs").textContent);
const [WIDE, HIGH, LEFT, RIGHT, TOP, BOTTOM] = [760, 420, 66, 12, 12, 46]; // The drawing and its margins.

const SVG = new DOMParser().parseFromString("<svg></svg>", "text/html").querySelector("svg").namespaceURI;

function drawn(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

// The axis through some values: its ends, its ticks and the digits that they need.
function axis(values) {
  const low = Math.min(...values), high = Math.max(...values), span = high - low || Math.abs(high) || 1;
  const power = 10 ** Math.floor(Math.log10(span / 5));
  const step = [1, 2, 5, 10].map(k => k * power).find(size => span / size <= 6);
  const ticks = [];
  for (let tick = Math.ceil(low / step); tick * step <= high; tick++) ticks.push(tick * step);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return { low: low - 0.04 * span, high: high + 0.04 * span, ticks, digits };
}

function trace(run) {
  const finite = value => value !== null;
  const across = axis(run.strokes.flatMap(one => one.x).filter(finite));
  const up = axis(run.strokes.flatMap(one => [...one.force, ...one.model]).filter(finite));
  const x = value => LEFT + (WIDE - LEFT - RIGHT) * (value - across.low) / (across.high - across.low);
  const y = value => HIGH - BOTTOM - (HIGH - TOP - BOTTOM) * (value - up.low) / (up.high - up.low);
  const svg = drawn("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, role: "img", "aria-label": run.label });
  for (const tick of across.ticks)
    svg.append(drawn("path", { d: `M${x(tick)} ${TOP}V${HIGH - BOTTOM}`, class: "grid" }),
      drawn("text", { x: x(tick), y: HIGH - 28, "text-anchor": "middle" }, tick.toFixed(across.digits)));
  for (const tick of up.ticks)
    svg.append(drawn("path", { d: `M${LEFT} ${y(tick)}H${WIDE - RIGHT}`, class: "grid" }),
      drawn("text", { x: LEFT - 8, y: y(tick) + 4, "text-anchor": "end" }, tick.toFixed(up.digits)));
  svg.append(drawn("text", { x: (LEFT + WIDE) / 2, y: HIGH - 8, "text-anchor": "middle" }, traces.x),
    drawn("text", { transform: `translate(14 ${HIGH / 2}) rotate(-90)`, "text-anchor": "middle" }, traces.y));
  const points = [];
  for (const one of run.strokes) {
    const places = one.x.map((at, i) => i).filter(i => one.x[i] !== null && one.force[i] !== null);
    const line = values =>
      "M" + places.filter(i => values[i] !== null).map(i => `${x(one.x[i])} ${y(values[i])}`).join("L");
    svg.append(drawn("path", { d: line(one.force), class: "measured" }));
    for (const i of places) {
      const point = drawn("circle", { cx: x(one.x[i]), cy: y(one.force[i]), r: 2.2, class: "measured" });
      const left = one.model[i] === null ? "" : `\nresidual: ${(one.force[i] - one.model[i]).toPrecision(3)}`;
      point.dataset.text = `${traces.y}: ${one.force[i]}${left}\n${traces.x}: ${one.x[i]}\n${one.file}`;
      points.push(point);
    }
    svg.append(drawn("path", { d: line(one.model), class: "model" }));
  }
  svg.append(...points);
  return explained(svg, points);
}

function openRun(id) {
  const run = traces.runs[id], files = [...new Set(run.strokes.map(one => one.file))];
  const each = traces.every === 1 ? "each bin" : `one of ${traces.every} bins`;
  const words = `Measured in blue, a point for ${each} of the steady window; model in orange. ${files.join(", ")}`;
  open(run.label, words, zoomable(trace(run)));
}

// ---------------------------------------------------------------- figures

function drawingOf(image) {
  const bytes = Uint8Array.from(atob(image.src.split(",")[1]), c => c.charCodeAt(0));
  return new TextDecoder().decode(bytes);
}

// A figure as an element whose ids are single in the page, and its points.
function parsed(text, label, number) {
  const svg = new DOMParser().parseFromString(text, "image/svg+xml").documentElement;
  const points = [...svg.querySelectorAll("use > title")].map(title => {
    const use = title.parentElement;
    use.dataset.text = title.textContent;
    title.remove();
    return use;
  });
  svg.querySelectorAll("style").forEach(style => style.remove());
  for (const element of svg.querySelectorAll("*")) {
    for (const attribute of [...element.attributes]) {
      if (attribute.name === "id") element.id = `f${number}-${attribute.value}`;
      else if (attribute.localName === "href") attribute.value = attribute.value.replace(/^#/, `#f${number}-`);
      else if (attribute.value.includes("url(#"))
        attribute.value = attribute.value.replaceAll("url(#", `url(#f${number}-`);
    }
  }
  svg.style.strokeLinejoin = "round";
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", label);
  return { svg: explained(svg, points), points };
}

// A drawing whose points say their texts under the pointer, and open the run that a line of the text names.
function explained(svg, points) {
  const run = point => point?.dataset.text.split("\n").find(line => Object.hasOwn(traces.runs, line));
  svg.addEventListener("pointermove", event => {
    const nearest = near(event, points);
    show(event, nearest);
    svg.style.cursor = run(nearest) === undefined ? "" : "pointer";
  });
  svg.addEventListener("pointerleave", () => tip.classList.remove("shown"));
  svg.addEventListener("click", event => {
    const id = run(near(event, points));
    if (id !== undefined) openRun(id);
  });
  return svg;
}

function near(event, points) {
  let nearest = null, least = NEAR;
  for (const point of points) {
    const box = point.getBoundingClientRect();
    const away = Math.hypot(box.x + box.width / 2 - event.clientX, box.y + box.height / 2 - event.clientY);
    if (away < least) [nearest, least] = [point, away];
  }
  return nearest;
}

function show(event, nearest) {
  tip.classList.toggle("shown", nearest !== null);
  if (nearest === null) return;
  tip.textContent = nearest.dataset.text;
  const room = document.documentElement.clientWidth - tip.offsetWidth - 8;
  tip.style.left = `${Math.max(8, Math.min(event.clientX + 14, room))}px`;
  tip.style.top = `${Math.max(8, event.clientY - tip.offsetHeight - 12)}px`;
}

[...document.querySelectorAll(".panels img")].forEach((image, number) => {
  const text = drawingOf(image), panel = document.createElement("div");
  panel.className = "panel";
  image.replaceWith(panel);
  const name = `${image.alt.split(/[:;.]/)[0].replace(/[^\p{L}\p{N}]+/gu, "_").slice(0, 60)}.svg`;
  const tools = document.createElement("div");
  tools.append(
    button("Enlarge", `Enlarge: ${image.alt}`, () =>
      open(image.alt, "The wheel zooms, a drag moves, a double click shows the whole figure.",
        zoomable(parsed(text, image.alt, "large").svg))),
    button("SVG", `Save as SVG: ${image.alt}`, () => save(text, "image/svg+xml", name)),
  );
  const { svg, points } = parsed(text, image.alt, number);
  panel.append(points.length ? svg : image, tools);
});

// ---------------------------------------------------------------- tables

const SUPERSCRIPT = "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079";

function plain(text) {
  return text.trim().replace(/\s+/g, " ").replaceAll("\u2212", "-")
    .replace(/ ?\u00d7 ?10([\u207b\u2070\u00b9\u00b2\u00b3\u2074-\u2079]+)/g, (_, power) =>
      "e" + [...power].map(c => (c === "\u207b" ? "-" : SUPERSCRIPT.indexOf(c))).join(""));
}

// A cell that a spreadsheet would take as a formula is made text.
function quoted(cell) {
  const text = /^[=+@\t]|^-(?![\d.])/.test(cell) ? `'${cell}` : cell;
  return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

function csv(table) {
  const rows = [...table.rows].map(row => [...row.cells].map(cell => quoted(plain(cell.textContent))).join(","));
  return rows.join("\r\n") + "\r\n";
}

function sorted(table, column, falling) {
  const body = table.tBodies[0], rows = [...body.rows], sign = falling ? -1 : 1;
  const key = row => plain(row.cells[column].textContent);
  const number = text => (/^[-+.\d]/.test(text) ? parseFloat(text) : NaN);
  rows.sort((one, other) => {
    const [a, b] = [key(one), key(other)], [x, y] = [number(a), number(b)];
    if (isNaN(x) !== isNaN(y)) return isNaN(x) ? 1 : -1; // numbers first, either way
    return sign * (isNaN(x) ? a.localeCompare(b) : x - y);
  });
  body.append(...rows);
}

for (const box of document.querySelectorAll(".box")) {
  const table = box.querySelector("table");
  const name = (box.getAttribute("aria-label") || "table").replace(/[^\p{L}\p{N}]+/gu, "_");
  const tools = document.createElement("p");
  tools.className = "tools";
  tools.append(
    button("Copy", `Copy: ${name}`, event => {
      const { target } = event; // a page that came by http has no clipboard
      const done = navigator.clipboard?.writeText(csv(table).replaceAll("\r\n", "\n")) ?? Promise.reject();
      done.then(() => "Copied", () => "Refused by the browser").then(text => (target.textContent = text));
    }),
    button("CSV", `Save as CSV: ${name}`, () => save("\ufeff" + csv(table), "text/csv", `${name}.csv`)),
  );
  box.before(tools);
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    head.tabIndex = 0;
    head.classList.add("sorts");
    const turn = () => {
      const falling = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", falling ? "descending" : "ascending");
      sorted(table, column, falling);
    };
    head.addEventListener("click", turn);
    head.addEventListener("keydown", event => {
      if (event.key === "Enter" || event.key === " ") {
        event.preventDefault();
        turn();
      }
    });
  });
}
