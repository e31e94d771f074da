"use strict";
// The panel: every control reads and writes one entry of the state, and says that it has changed.

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

class Panel {
  // state: plain values by name; changed: told the name of what has changed
  constructor(root, state, changed) {
    Object.assign(this, { root, state, changed, writers: [] });
  }

  group(title, ...children) {
    const box = element("fieldset", {}, element("legend", {}, title), ...children);
    this.root.append(box);
    return box;
  }

  set(name, value) {
    this.state[name] = value;
    this.changed(name);
    this.show();
  }

  // Controls show the state as it is now.
  show() { for (const write of this.writers) write(); }

  slider(name, title, low, high, step, text) {
    const input = element("input", { type: "range", min: low, max: high, step, "aria-label": title,
      oninput: () => this.set(name, Number(input.value)) });
    const output = element("output");
    this.writers.push(() => { input.value = this.state[name]; output.textContent = text(this.state[name]); });
    return element("label", {}, title, input, output);
  }

  tick(name, title) {
    const input = element("input", { type: "checkbox", onchange: () => this.set(name, input.checked) });
    this.writers.push(() => { input.checked = this.state[name]; });
    return element("label", { class: "tick" }, input, title);
  }

  // choices: [[value, title, key or ""]]
  buttons(name, choices) {
    const row = element("div", { class: "row", role: "group" });
    for (const [value, title, key] of choices) {
      const button = element("button", { type: "button", title: key && `key ${key}`, onclick: () => this.set(name, value) }, title);
      this.writers.push(() => button.setAttribute("aria-pressed", this.state[name] === value));
      row.append(button);
    }
    return row;
  }
}

// A legend of false colour or of differences, with its unit.
function drawLegend(canvas, look, unit) {
  canvas.hidden = look.mode === 0;
  if (look.mode === 0) return;
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.font = "12px system-ui, sans-serif";
  const top = height - 16, bar = 12, colours = look.mode === 1 ? RAMP : [[13, 77, 158], [245, 245, 245], [191, 82, 5]];
  const fill = pen.createLinearGradient(4, 0, width - 4, 0);
  colours.forEach((c, n) => fill.addColorStop(n / (colours.length - 1), `rgb(${c})`));
  pen.fillStyle = fill; pen.fillRect(4, top - bar, width - 8, bar);
  pen.fillStyle = "#eceff3";
  const label = (share, text) => {
    pen.textAlign = share === 0 ? "left" : share === 1 ? "right" : "center";
    pen.fillText(text, 4 + share * (width - 8), top + 13);
  };
  if (look.mode === 2) {
    [-1, 0, 1].forEach((s) => label((s + 1) / 2, `${s > 0 ? "+" : ""}${Math.round(100 * s * look.span)} %`));
    pen.textAlign = "left"; pen.fillText("relit minus reference, of white", 4, top - bar - 4);
    return;
  }
  for (let d = 0; d <= look.decades; d++) label(1 - d / look.decades, (look.white * 10 ** -d).toExponential(0));
  pen.textAlign = "left"; pen.fillText(unit, 4, top - bar - 4);
}

// A bar of a round length in mm, about a sixth of the stage wide.
function drawScale(box, mmPerPixel, width) {
  const wanted = (width / 6) * mmPerPixel, lengths = [0.5, 1, 2, 5, 10, 20, 50, 100];
  const mm = lengths.reduce((a, b) => (Math.abs(Math.log(b / wanted)) < Math.abs(Math.log(a / wanted)) ? b : a));
  box.firstElementChild.style.width = `${mm / mmPerPixel}px`;
  box.lastElementChild.textContent = `${mm} mm`;
}
