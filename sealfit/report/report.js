"use strict";
// The page is whole without this script. With it, points say their values under the pointer, tables are sorted by
// a click on their heads, and tables and figures can be saved.

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

// ---------------------------------------------------------------- figures

function drawingOf(image) {
  const bytes = Uint8Array.from(atob(image.src.split(",")[1]), c => c.charCodeAt(0));
  return new TextDecoder().decode(bytes);
}

// An inline copy of a figure with points; its ids are made single in the page.
function inline(text, image, number) {
  const svg = new DOMParser().parseFromString(text, "image/svg+xml").documentElement;
  const points = [...svg.querySelectorAll("use > title")].map(title => {
    const use = title.parentElement;
    use.dataset.text = title.textContent;
    title.remove();
    return use;
  });
  if (!points.length) return;
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
  svg.setAttribute("aria-label", image.alt);
  svg.addEventListener("pointermove", event => show(event, points));
  svg.addEventListener("pointerleave", () => tip.classList.remove("shown"));
  image.replaceWith(svg);
}

function show(event, points) {
  let nearest = null, least = NEAR;
  for (const point of points) {
    const box = point.getBoundingClientRect();
    const away = Math.hypot(box.x + box.width / 2 - event.clientX, box.y + box.height / 2 - event.clientY);
    if (away < least) [nearest, least] = [point, away];
  }
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
  panel.append(image, button("SVG", `Save as SVG: ${image.alt}`, () => save(text, "image/svg+xml", name)));
  inline(text, image, number);
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
  const rows = [...table.rows].map(row => [...row.cells].flatMap(cell =>
    [quoted(plain(cell.textContent)), ...Array(cell.colSpan - 1).fill("")]).join(","));
  return rows.join("\r\n") + "\r\n";
}

function sorted(table, column, falling) {
  const body = table.tBodies[0], rows = [...body.rows], sign = falling ? -1 : 1;
  const key = row => plain(row.cells[column]?.textContent ?? "");
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
      navigator.clipboard.writeText(csv(table).replaceAll("\r\n", "\n"));
      event.target.textContent = "Copied";
    }),
    button("CSV", `Save as CSV: ${name}`, () => save("\ufeff" + csv(table), "text/csv", `${name}.csv`)),
  );
  box.before(tools);
  const heads = table.tHead?.rows;
  const even = [...(table.tBodies[0]?.rows ?? [])].every(row => row.cells.length === heads?.[0].cells.length);
  if (heads?.length !== 1 || !even) continue; // rows of notes belong to the row above
  [...heads[0].cells].forEach((head, column) => {
    head.tabIndex = 0;
    head.classList.add("sorts");
    const turn = () => {
      const falling = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads[0].cells) other.removeAttribute("aria-sort");
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
