"use strict";
/* What the other scripts share: the page's data, arrays as they were packed, colours, and who is told of what. */
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const dark = matchMedia("(prefers-color-scheme: dark)");

const told = {};
/** Call `listener` whenever `name` is told. */
const when = (name, listener) => { (told[name] ||= []).push(listener); };
/** Tell all listeners of `name` but the one it comes from. */
const tell = (name, value, from) => { for (const listener of told[name] || []) if (listener !== from) listener(value); };

/** What one script can do for another, once it can. */
const offers = {};

/* on paper nothing can be opened: what is folded is printed unfolded */
const folded = () => document.querySelectorAll("details:not([open])");
let unfolded = [];
addEventListener("beforeprint", () => { unfolded = [...folded()]; for (const one of unfolded) one.open = true; });
addEventListener("afterprint", () => { for (const one of unfolded) one.open = false; });

/** The bytes behind base64 of a deflated stream. */
async function inflated(text) {
  const raw = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([raw]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** A packed array (report/pack.py): whole numbers, row by row. */
async function unpacked(form) {
  const { bytes, columns, count } = form, size = columns * count;
  const planes = await inflated(form.data);
  const out = new ({ 1: Uint8Array, 2: Uint16Array, 4: Uint32Array }[bytes])(size);
  for (let column = 0; column < columns; column++) {
    let last = 0;
    for (let row = 0, at = column * count; row < count; row++, at++) {
      let folded = 0;
      for (let k = bytes - 1; k >= 0; k--) folded = (folded << 8) | planes[k * size + at];
      last += (folded >>> 1) ^ -(folded & 1);
      out[row * columns + column] = last;
      last = out[row * columns + column];
    }
  }
  return out;
}

/** Packed numbers: NaN where there is none. */
async function unpackedFloats(form) {
  const codes = await unpacked(form), out = new Float32Array(codes.length);
  for (let i = 0; i < codes.length; i++) out[i] = codes[i] ? form.low + (codes[i] - 1) * form.step : NaN;
  return out;
}

/** [r, g, b] in 0..255 at `t` in 0..1 of a colour table. */
function colourAt(name, t) {
  const table = data.colours[name], x = Math.min(1, Math.max(0, t)) * (table.length - 1), i = Math.min(table.length - 2, Math.floor(x));
  return table[i].map((v, k) => v + (x - i) * (table[i + 1][k] - v));
}

/** A scale of colours with its ends and unit in `where`, and `about` under it. */
function drawScale(where, name, low, high, unit, about) {
  const bar = document.createElement("canvas"), ends = document.createElement("div");
  bar.width = 128; bar.height = 1; bar.setAttribute("aria-hidden", "true");
  const context = bar.getContext("2d");
  for (let x = 0; x < 128; x++) { context.fillStyle = `rgb(${colourAt(name, x / 127).map(Math.round).join(",")})`; context.fillRect(x, 0, 1, 1); }
  ends.className = "ends";
  for (const value of [low, (low + high) / 2, high]) { const end = document.createElement("span"); end.textContent = `${short(value)} ${unit}`; ends.append(end); }
  where.replaceChildren(bar, ends);
  if (about) { const text = document.createElement("p"); text.textContent = about; where.append(text); }
}

/** A number with three digits that matter. */
const short = (x) => (x === 0 ? "0" : Math.abs(x) >= 100 ? x.toFixed(0) : String(Number(x.toPrecision(3)))).replace("-", "−");
/** With one decimal, and no minus before nought. */
const tenth = (x) => (Math.round(x * 10) / 10 || 0).toFixed(1).replace("-", "−");
const point = (p) => `(${Array.from(p, tenth).join(", ")}) mm`;
