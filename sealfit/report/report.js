"use strict";
// The page is whole without this script. With it, a click on the mean of a run opens its trace, figures are enlarged
// and zoomed, tables are sorted by a click on their heads, and tables and figures can be saved.

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
// An enlarged figure has the ids of the one in the page, which must be unique.
dialog.addEventListener("close", () => dialog.replaceChildren());

// The wheel zooms a drawing about the pointer; its scroll bars move it.
function open(title, note, svg) {
  const head = document.createElement("h2"), words = document.createElement("p"), frame = document.createElement("div");
  head.textContent = title;
  words.textContent = note;
  words.className = "quiet";
  frame.append(svg);
  let size = 1;
  frame.addEventListener("wheel", event => {
    event.preventDefault();
    const wanted = Math.min(40, Math.max(1, size * 0.9985 ** event.deltaY)), grown = wanted / size;
    const shown = svg.getBoundingClientRect();
    size = wanted;
    svg.style.width = `${100 * size}%`;
    frame.scrollLeft += (event.clientX - shown.x) * (grown - 1);
    frame.scrollTop += (event.clientY - shown.y) * (grown - 1);
  }, { passive: false });
  dialog.replaceChildren(button("Close", "Close", () => dialog.close()), head, frame, words);
  if (!dialog.open) dialog.showModal();
  size = Math.max(1, svg.width.baseVal.value / frame.clientWidth); // at least as large as it was drawn
  svg.style.width = `${100 * size}%`;
}

// ---------------------------------------------------------------- trace of a run

const traces = JSON.parse(document.getElementById("runs").textContent);
const [WIDE, HIGH, LEFT, RIGHT, TOP, BOTTOM] = [760, 420, 66, 12, 12, 46]; // The drawing and its margins.

const SVG = document.querySelector("figure svg")?.namespaceURI;

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
  for (const one of run.strokes) {
    const line = values => "M" + one.x.map((at, i) => [at, values[i]]).filter(point => point.every(finite))
      .map(([at, value]) => `${x(at)} ${y(value)}`).join("L");
    svg.append(drawn("path", { d: line(one.force), class: "measured" }),
      drawn("path", { d: line(one.model), class: "model" }));
  }
  return svg;
}

function openRun(id) {
  const run = traces.runs[id], files = [...new Set(run.strokes.map(one => one.file))];
  const each = traces.every === 1 ? "each bin" : `one of ${traces.every} bins`;
  const words = `Measured in blue, ${each} of the steady window; model in orange. ${files.join(", ")}`;
  open(run.label, words, trace(run));
}

// ---------------------------------------------------------------- figures

// The point with a text nearest to the pointer: the places around neighbouring points overlap.
function pointAt({ clientX, clientY }) {
  const distance = point => {
    const box = point.getBoundingClientRect();
    return Math.hypot(box.x + box.width / 2 - clientX, box.y + box.height / 2 - clientY);
  };
  const points = document.elementsFromPoint(clientX, clientY).map(element => element.closest("use"));
  return points.filter(point => point?.querySelector("title")).sort((one, other) => distance(one) - distance(other))[0];
}

// A point that names a run, in a line of its text, opens it.
document.addEventListener("click", event => {
  const text = pointAt(event)?.querySelector("title").textContent ?? "";
  const id = text.split("\n").find(line => Object.hasOwn(traces.runs, line));
  if (id !== undefined) openRun(id);
});

function tools(...buttons) {
  const made = document.createElement("p");
  made.className = "tools";
  made.append(...buttons);
  return made;
}

for (const figure of document.querySelectorAll("figure")) {
  const svg = figure.querySelector("svg"), label = svg.getAttribute("aria-label"), title = label.split(":")[0];
  const name = `${title.replace(/[^\p{L}\p{N}]+/gu, "_")}.svg`;
  figure.prepend(tools(
    button("Enlarge", `Enlarge: ${title}`, () => open(title, "The wheel zooms.", svg.cloneNode(true))),
    button("SVG", `Save as SVG: ${title}`, () =>
      save(new XMLSerializer().serializeToString(svg), "image/svg+xml", name)),
  ));
}

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
  box.before(tools(
    button("Copy", `Copy: ${name}`, event => {
      const { target } = event; // a page that came by http has no clipboard
      const done = navigator.clipboard?.writeText(csv(table).replaceAll("\r\n", "\n")) ?? Promise.reject();
      done.then(() => "Copied", () => "Refused by the browser").then(text => (target.textContent = text));
    }),
    button("CSV", `Save as CSV: ${name}`, () => save("\ufeff" + csv(table), "text/csv", `${name}.csv`)),
  ));
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
