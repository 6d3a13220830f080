// Small helpers. Text is always set as text, never as HTML.

export const $ = (id) => document.getElementById(id);

/** An element: `make("b", { className: "x", onclick }, "text", child)`. */
export function make(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "style") Object.assign(made.style, value);
    else if (name.includes("-")) made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** Change only what differs, so that hover and selection last. */
export function text(element, value) {
  if (element.textContent !== value) element.textContent = value;
}

export function toast(message, fine = false) {
  const shown = make("div", { className: fine ? "toast fine" : "toast" }, message);
  const all = $("toasts");
  for (const other of [...all.children]) if (other.textContent === message) other.remove();
  all.append(shown);
  while (all.children.length > 4) all.firstChild.remove();
  setTimeout(() => shown.remove(), fine ? 4000 : 9000);
}

export const number = (value, digits = 2) => (value === null || value === undefined ? "–" : value.toFixed(digits));

const COLOURS = ["#2f7df6", "#e8590c", "#12a150", "#c026d3", "#d99a00", "#0ea5b7", "#e11d48", "#7c5cff"];
export const colour = (index) => COLOURS[index % COLOURS.length];

export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
