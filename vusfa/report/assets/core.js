"use strict";
// What all parts of the page share: the data, colours, numbers in words, the tip beside the pointer.

const DATA = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

// Elements are built, never parsed from text: a name in the data can be no markup.
function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

// Plotly reads a few tags and its own %{fields} in its texts.
const plain = (text) => String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll("%{", "% {");

function fill(select, options, chosen) {
  select.replaceChildren(...options.map(([value, words]) => make("option", { value }, words)));
  if (options.some(([value]) => String(value) === String(chosen))) select.value = chosen;
}

// ---- packed arrays, see packing.py

function bytes(text) {
  const binary = atob(text);
  const result = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) result[i] = binary.charCodeAt(i);
  return result;
}

function unpack(packed) {
  if (packed.values) return packed.values; // unpacked before
  const raw = bytes(packed.data);
  const levels = packed.type === "u8" ? raw : new Uint16Array(raw.buffer);
  if (packed.low === undefined) return (packed.values = levels);
  const most = packed.type === "u8" ? 254 : 65534;
  const values = new Float32Array(levels.length);
  const step = (packed.high - packed.low) / most;
  for (let i = 0; i < levels.length; i++) values[i] = levels[i] > most ? NaN : packed.low + levels[i] * step;
  packed.data = null;
  return (packed.values = values);
}

// ---- colours: all of them told apart by the colour-blind

const MODELS = {
  light: ["#0072b2", "#d55e00", "#009e73", "#b5478f", "#b57f00", "#2b9bd6", "#6a51a3", "#4d4d4d"],
  dark: ["#56a8e8", "#ff8a3d", "#2dc79c", "#e896c8", "#f0b840", "#8fd3f7", "#b09be0", "#c4c4c4"],
};
const SYMBOLS = ["circle", "diamond", "square", "triangle-up", "cross", "x", "star", "hexagon"];
const DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "solid", "dash"];
const VIRIDIS = ["#440154", "#482878", "#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];
// Its middle, 0, is the ground of the page: what is far from 0 stands out in light and in dark.
const DIVERGING = {
  light: ["#3b1f6b", "#5e4fa2", "#8073ac", "#b2abd2", "#e6e6ef", "#f7f7f7", "#fbe3c4", "#fdb863", "#e08214", "#b35806", "#7f3b08"],
  dark: ["#d9c8ff", "#b7a2f2", "#8f7bd4", "#66579c", "#3f3a5c", "#2b3138", "#56422c", "#8f5f24", "#cc8428", "#f5ab4c", "#ffd59a"],
};
const HEAT = {
  light: ["#eef1f4", "#fde0a6", "#fdb863", "#ee7b3b", "#c43c4e", "#7a1f66", "#3b0f4f"],
  dark: ["#20272e", "#4a2a52", "#8a2f5e", "#c94a4f", "#ee7b3b", "#fdb863", "#fff3cf"],
};

const theme = () => document.documentElement.dataset.theme;
const tone = (stops) => (Array.isArray(stops) ? stops : stops[theme()]);
const place = (label) => DATA.models.findIndex((model) => model.label === label);
const colourOf = (label) => MODELS[theme()][Math.max(0, place(label)) % 8];
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

const parsed = new Map();
function rgb(hex) {
  if (!parsed.has(hex)) parsed.set(hex, [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  return parsed.get(hex);
}

function ramp(stops, share) {
  if (!Number.isFinite(share)) return "none";
  const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(at), stops.length - 2);
  const [a, b] = [rgb(stops[low]), rgb(stops[low + 1])];
  return `rgb(${a.map((value, i) => Math.round(value + (b[i] - value) * (at - low))).join(" ")})`;
}

function faded(hex, opacity) {
  return `rgba(${rgb(hex).join(", ")}, ${opacity})`;
}

function drawScale(host, stops, low, high, unit) {
  const bar = make("i");
  bar.style.background = `linear-gradient(90deg, ${tone(stops).join(", ")})`;
  host.replaceChildren(low, bar, unit ? `${high} ${unit}` : high);
}

// ---- numbers and names in words

const METRICS = Object.fromEntries(DATA.metrics.map((metric) => [metric.name, metric]));
const SHOWN = DATA.metrics.filter((metric) => !metric.exact).map((metric) => metric.name);
const isShare = (name) => Boolean(METRICS[name]?.share);
const headOf = (name) => METRICS[name].label;
const titleOf = (name) => METRICS[name].title + (isShare(name) ? " (%)" : "");
const plural = (count, word) => `${grouped(count)} ${word}${count === 1 ? "" : "s"}`;
const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

function number(name, value) {
  if (!known(value)) return "–";
  return ((isShare(name) ? 100 : 1) * value).toFixed(METRICS[name].digits);
}

// 99.95 % is not 100 %, nor is 0.03 % nothing
function percent(value) {
  if (!known(value)) return "not known";
  if (value > 0 && value < 0.001) return "under 0.1\u00a0%";
  const near = (value > 0.99 && value < 1) || (value > 0 && value < 0.01);
  return `${near ? (Math.floor(1000 * value) / 10).toFixed(1) : (100 * value).toFixed(0)}\u00a0%`;
}
const grouped = (value) => Math.round(value).toLocaleString("en-GB").replaceAll(",", " ");

// ---- the tip

function tell(event, ...content) {
  const tip = $("tip");
  tip.replaceChildren(...content);
  tip.hidden = false;
  const box = tip.getBoundingClientRect();
  const left = event.clientX + 16 + box.width > innerWidth ? event.clientX - box.width - 12 : event.clientX + 16;
  const top = event.clientY + 16 + box.height > innerHeight ? event.clientY - box.height - 12 : event.clientY + 16;
  tip.style.left = `${Math.max(4, left)}px`;
  tip.style.top = `${Math.max(4, top)}px`;
}

const hush = () => ($("tip").hidden = true);

// ---- pictures of states, each made when it is first looked at

const pictureUrls = new Map();
function picture(scene, state) {
  const held = DATA.scenes[scene].pictures;
  if (!held || !held.ids.length) return null;
  held.places ||= new Map(held.ids.map((id, at) => [id, at]));
  const at = held.places.get(state);
  if (at === undefined) return null;
  held.raw ||= bytes(held.data);
  const key = `${scene}/${state}`;
  if (!pictureUrls.has(key)) {
    const file = held.raw.subarray(at ? held.ends[at - 1] : 0, held.ends[at]);
    pictureUrls.set(key, URL.createObjectURL(new Blob([file], { type: "image/jpeg" })));
  }
  return pictureUrls.get(key);
}

function showPicture(image, scene, state) {
  const url = picture(scene, state);
  if (url) image.src = url;
  else image.removeAttribute("src");
}

const redraws = []; // called when the theme changes
