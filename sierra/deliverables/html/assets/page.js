"use strict";
// Draws the charts of each section from the data in its script element, and copies its tables as CSV.
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const number = (value) => (typeof value === "number" ? value : null);
  const shown = (value) => {
    if (typeof value === "number") return String(Number.isInteger(value) ? value : Number(value.toPrecision(6))).replaceAll("-", "−");
    return value === null || value === undefined ? "–" : visible(value);
  };

  // A text with escapes for the characters for which the server's html.escaping, too, shows them: html/page.py fills them in.
  const visible = (text) => String(text).replace(/[STEERING]/gu, (found) => {
    const code = found.codePointAt(0), [letter, width] = code < 0x100 ? ["x", 2] : code < 0x10000 ? ["u", 4] : ["U", 8];
    return `\\${letter}${code.toString(16).padStart(width, "0")}`;
  });

  function make(name, parent, attributes = {}, text = "") {
    const element = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.textContent = visible(text);
    parent.append(element);
    return element;
  }

  // One series: its rows by x, and its arrays for uPlot.
  function prepared(spec, table, one) {
    const [start, stop] = one.rows;
    const values = (place) => (place < 0 ? Array(stop - start).fill(null) : table.columns[place].slice(start, stop));
    const place = new Map(spec.x.names.map((name, k) => [name, k]));
    const position = (value) => (spec.x.names.length ? place.get(value) ?? null : number(value));
    const xs = spec.x.column < 0 ? Array(stop - start).fill(0) : values(spec.x.column).map(position);
    const drawable = (value) => (number(value) === null || (spec.y.log && !(value > 0)) ? null : value);
    const kept = xs.map((x, k) => k).filter((k) => xs[k] !== null && !(spec.x.log && !(xs[k] > 0)));
    const pick = (list) => kept.map((k) => list[k]);
    const x = pick(xs);
    const row = new Map(x.map((at, k) => [at, kept[k]]));
    const { low, high, n, never } = spec.columns;
    const facts = { center: values(spec.y.column), low: values(low), high: values(high), n: values(n), never: values(never) };
    return {
      ...one,
      shown: true,
      facts: (at) => {
        const k = row.get(at);
        return k === undefined ? null : Object.fromEntries(Object.entries(facts).map(([name, list]) => [name, list[k]]));
      },
      arrays: [x, pick(facts.center.map(drawable)), pick(facts.low.map(number)), pick(facts.high.map(number))],
    };
  }

  class ChartView {
    constructor(section, spec, table, holder) {
      Object.assign(this, { section, spec, holder });
      this.box = holder.querySelector(".plot");
      this.series = spec.series.map((one) => prepared(spec, table, one));
      this.data = uPlot.join(this.series.map((one) => one.arrays));
      this.xs = this.data[0];
      this.whole = this.extent();
      this.buildTools();
      this.buildReadout();
      this.plot = new uPlot(this.options(), this.data, this.box);
      this.bindKeys();
      new ResizeObserver(() => this.plot.setSize(this.size())).observe(this.box);
      dark.addEventListener("change", () => this.recolour());
      this.recolour();
      this.read(this.xs.length - 1);
    }

    // The range of x that shows everything.
    extent() {
      const { x, form } = this.spec;
      if (x.limits) return x.limits;
      if (x.names.length) return [-0.5, x.names.length - 0.5];
      if (!this.xs.length) return [1, 2];
      const [low, high] = [this.xs[0], this.xs[this.xs.length - 1]];
      if (low === high) return x.log ? [low / 2, low * 2] : [low - 1, high + 1];
      const margin = form === "points" ? 0.06 : 0;
      return x.log ? [low * (low / high) ** margin, high * (high / low) ** margin] : [low - (high - low) * margin, high + (high - low) * margin];
    }

    size() {
      const width = Math.max(this.box.clientWidth, 120);
      return { width, height: Math.round(Math.min(Math.max(width * 0.55, 220), 440)) };
    }

    colour(one) {
      return one.colours[dark.matches ? 1 : 0];
    }

    options() {
      const { x, y, form } = this.spec;
      const ink = () => style("--ink");
      const grid = { stroke: () => style("--line"), width: 1 };
      const axis = { stroke: ink, grid, ticks: grid, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
      const lines = this.series.flatMap((one) => this.lines(one));
      return {
        ...this.size(),
        legend: { show: false },
        scales: {
          x: { time: false, auto: false, min: this.whole[0], max: this.whole[1], range: (_, low, high) => [low, high], ...this.scale(x) },
          y: { ...(y.limits ? { range: y.limits } : {}), ...this.scale(y) },
        },
        axes: [{ ...axis, label: visible(x.label), ...this.ticks(x) }, { ...axis, label: visible(y.label), size: (_, values) => 24 + 7 * Math.max(3, ...(values || []).map((value) => String(value ?? "").length)) }],
        series: [{}, ...lines],
        bands: form === "lines" ? this.series.map((one, k) => this.band(one, k)) : [],
        cursor: {
          y: false,
          drag: { x: true, y: false, setScale: false },
          sync: { key: this.section.key, setSeries: false },
          points: { show: form === "lines" },
          bind: { dblclick: () => () => this.section.zoom(null) },
          dataIdx: (plot, place, index) => (place ? this.nearest(place, index) : index),
        },
        hooks: {
          setCursor: [(plot) => plot.cursor.idx !== null && plot.cursor.idx !== undefined && this.read(plot.cursor.idx)],
          setSelect: [(plot) => this.selected(plot)],
          draw: form === "points" ? [(plot) => this.points(plot)] : [],
        },
      };
    }

    scale(axis) {
      return axis.log ? { distr: 3, log: axis.log } : {};
    }

    ticks(axis) {
      const name = (value) => shown(axis.names.length ? axis.names[value] ?? "" : value);
      const at = axis.names.length ? axis.names.map((_, k) => k) : axis.ticks;
      if (!at.length) return {};
      const fits = (plot) => Math.max(1, Math.ceil((at.length * this.widest(axis, at)) / Math.max(plot.bbox.width / devicePixelRatio, 1)));
      return {
        splits: (plot) => at.filter((_, k) => k % fits(plot) === 0),
        values: (_, values) => values.map((value) => this.short(name(value))),
        filter: (_, values) => values,
      };
    }

    short(name) {
      return name.length > 18 ? `${name.slice(0, 8)}…${name.slice(-8)}` : name;
    }

    widest(axis, at) {
      return 7 * Math.max(...at.map((value) => this.short(shown(axis.names.length ? axis.names[value] : value)).length)) + 10;
    }

    // Three series of uPlot for each of ours: center, low and high.
    lines(one) {
      const { form, joined } = this.spec;
      const edge = { stroke: "transparent", width: 0, points: { show: false }, paths: form === "points" ? () => null : undefined };
      const center = { label: one.name, stroke: () => this.colour(one), width: 2, dash: one.dashes };
      if (form === "points") Object.assign(center, { points: { show: false }, spanGaps: true }, joined ? {} : { paths: () => null });
      return [center, { ...edge }, { ...edge }];
    }

    band(one, k) {
      return { series: [3 * k + 3, 3 * k + 2], fill: () => `${this.colour(one)}38` };
    }

    // Points with their intervals, those of several series beside each other.
    points(plot) {
      const context = plot.ctx;
      const dense = devicePixelRatio;
      const { left, top, width, height } = plot.bbox;
      context.save();
      context.beginPath();
      context.rect(left, top - 6 * dense, width, height + 6 * dense);
      context.clip();
      this.series.forEach((one, k) => one.shown && this.pointsOf(plot, one, this.shift(k) * dense, dense));
      context.restore();
    }

    shift(k) {
      const count = this.series.length;
      return (k - (count - 1) / 2) * Math.min(5, 40 / count);
    }

    pointsOf(plot, one, shift, dense) {
      const context = plot.ctx;
      const colour = this.colour(one);
      const at = (value) => Math.min(Math.max(plot.valToPos(value, "y", true), -1e6), 1e6);
      Object.assign(context, { strokeStyle: colour, lineWidth: 1.5 * dense });
      context.setLineDash([]);
      for (const x of one.arrays[0]) {
        const facts = one.facts(x);
        const px = plot.valToPos(x, "x", true) + shift;
        const center = number(facts.center);
        if (number(facts.low) !== null && number(facts.high) !== null) this.interval(context, px, at(facts.low), at(facts.high), 3 * dense);
        context.beginPath();
        if (center !== null) context.arc(px, at(center), 3.5 * dense, 0, 2 * Math.PI);
        else if (facts.never > 0) this.triangle(context, px, plot.bbox.top, 4 * dense);
        context.fillStyle = facts.never > 0 ? style("--paper") : colour;
        context.fill();
        context.stroke();
      }
    }

    interval(context, x, low, high, cap) {
      context.beginPath();
      context.moveTo(x, low);
      context.lineTo(x, high);
      for (const y of [low, high]) {
        context.moveTo(x - cap, y);
        context.lineTo(x + cap, y);
      }
      context.stroke();
    }

    triangle(context, x, y, half) {
      context.moveTo(x - half, y + half);
      context.lineTo(x + half, y + half);
      context.lineTo(x, y - half);
      context.closePath();
    }

    // The nearest index at which a series has a value: series may have different x.
    nearest(place, index) {
      const values = this.data[place];
      for (let away = 0; away < values.length; away++) {
        for (const at of [index - away, index + away]) if (values[at] !== null && values[at] !== undefined) return at;
      }
      return index;
    }

    nearestRow(one, index) {
      for (let away = 0; away < this.xs.length; away++) {
        for (const at of [index - away, index + away]) {
          const facts = at >= 0 && at < this.xs.length ? one.facts(this.xs[at]) : null;
          if (facts) return { facts, x: this.xs[at] };
        }
      }
      return null;
    }

    buildTools() {
      const tools = make("div", this.holder, { class: "tools" });
      const add = (label, title, act) => make("button", tools, { type: "button", "aria-label": title, title }, label).addEventListener("click", act);
      add("+", "Zoom in", () => this.scaled(0.5));
      add("−", "Zoom out", () => this.scaled(2));
      add("◀", "Move left", () => this.moved(-0.25));
      add("▶", "Move right", () => this.moved(0.25));
      add("Show all", "Show all", () => this.section.zoom(null));
    }

    // The legend is the table of the values at the cursor.
    buildReadout() {
      const table = make("table", make("div", this.holder, { class: "scroll readout" }));
      this.caption = make("caption", table, { dir: "auto" });
      const head = make("tr", make("thead", table));
      make("th", head, { scope: "col", dir: "auto" }, this.spec.group || "series");
      for (const name of ["value", "interval", "n"]) make("th", head, { scope: "col", class: "number" }, name);
      const body = make("tbody", table);
      this.rows = this.series.map((one) => this.row(one, body));
      this.heard = make("output", this.holder, { class: "heard", "aria-live": "polite" });
    }

    row(one, body) {
      const line = make("tr", body);
      const button = make("button", make("th", line, { scope: "row" }), { type: "button", class: "series", "aria-pressed": "true" });
      const swatch = make("span", button, { class: "swatch", "aria-hidden": "true" });
      make("span", button, { dir: "auto" }, one.name || this.spec.y.label);
      button.addEventListener("click", () => this.section.toggle(one.name));
      const cells = ["value", "interval", "n"].map((name) => make("td", line, { class: `number ${name}` }));
      return { button, swatch, cells };
    }

    // Show the values at an index of x.
    read(index) {
      if (index < 0) return;
      this.index = index;
      const { x } = this.spec;
      const name = (at) => shown(x.names.length ? x.names[at] : at);
      this.caption.textContent = x.column < 0 ? "" : `${visible(x.label)} = ${name(this.xs[index])}`;
      this.said = this.series.map((one, k) => {
        const found = this.nearestRow(one, index);
        const facts = found ? found.facts : {};
        const never = facts.never > 0 ? ` (${shown(facts.never)} never)` : "";
        const elsewhere = found && found.x !== this.xs[index] ? ` at ${name(found.x)}` : "";
        const interval = facts.low === null || facts.low === undefined ? "–" : `[${shown(facts.low)}, ${shown(facts.high)}]`;
        const texts = [shown(facts.center) + elsewhere, interval, shown(facts.n) + never];
        this.rows[k].cells.forEach((cell, place) => (cell.textContent = texts[place]));
        return one.shown ? `${visible(one.name)} ${texts[0]}, interval ${interval}, n = ${texts[2]}` : "";
      });
    }

    toggle(name) {
      this.series.forEach((one, k) => {
        if (one.name !== name) return;
        one.shown = !one.shown;
        this.rows[k].button.setAttribute("aria-pressed", String(one.shown));
        for (const place of [1, 2, 3]) this.plot.setSeries(3 * k + place, { show: one.shown });
      });
    }

    recolour() {
      this.series.forEach((one, k) => (this.rows[k].swatch.style.backgroundColor = this.colour(one)));
      this.plot.redraw(false, true);
    }

    selected(plot) {
      const { left, width } = plot.select;
      if (width < 4) return;
      this.section.zoom([plot.posToVal(left, "x"), plot.posToVal(left + width, "x")]);
      plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    }

    zoom(range) {
      const [min, max] = range || this.whole;
      if (min < max) this.plot.setScale("x", { min, max });
    }

    // Zoom by a factor around the cursor, or around the middle if the cursor is outside.
    scaled(factor) {
      const { min, max } = this.plot.scales.x;
      const [to, from] = this.spec.x.log ? [Math.log, Math.exp] : [(v) => v, (v) => v];
      const cursor = this.xs[this.index];
      const middle = cursor >= min && cursor <= max ? to(cursor) : (to(min) + to(max)) / 2;
      const [low, high] = [middle - (middle - to(min)) * factor, middle + (to(max) - middle) * factor];
      this.section.zoom([Math.max(from(low), this.whole[0]), Math.min(from(high), this.whole[1])]);
    }

    moved(part) {
      const [to, from] = this.spec.x.log ? [Math.log, Math.exp] : [(v) => v, (v) => v];
      const [min, max, first, last] = [this.plot.scales.x.min, this.plot.scales.x.max, ...this.whole].map(to);
      const by = Math.min(Math.max((max - min) * part, first - min), last - max);
      this.section.zoom([from(min + by), from(max + by)]);
    }

    bindKeys() {
      const keys = {
        ArrowLeft: () => this.step(this.index - 1),
        ArrowRight: () => this.step(this.index + 1),
        Home: () => this.step(0),
        End: () => this.step(this.xs.length - 1),
        "+": () => this.scaled(0.5),
        "=": () => this.scaled(0.5),
        "-": () => this.scaled(2),
        0: () => this.section.zoom(null),
        Escape: () => this.section.zoom(null),
      };
      this.box.addEventListener("keydown", (event) => {
        const act = keys[event.key];
        if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        act();
      });
    }

    // Move the cursor to an index of x, into view, and say the values there.
    step(index) {
      const at = Math.min(Math.max(index, 0), this.xs.length - 1);
      const { min, max } = this.plot.scales.x;
      if (this.xs[at] < min || this.xs[at] > max) {
        const by = this.xs[at] < min ? this.xs[at] - min : this.xs[at] - max;
        if (this.spec.x.log) this.section.zoom(null);
        else this.section.zoom([min + by, max + by]);
      }
      this.plot.setCursor({ left: this.plot.valToPos(this.xs[at], "x"), top: 0 });
      this.read(at);
      this.heard.textContent = `${this.caption.textContent}: ${this.said.filter(Boolean).slice(0, 8).join("; ")}`;
    }
  }

  function quoted(value) {
    const text = value === null ? "" : String(value);
    return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  }

  function csv(table) {
    const rows = table.columns.length ? table.columns[0].map((_, k) => table.columns.map((column) => column[k])) : [];
    return [table.headers, ...rows].map((row) => row.map(quoted).join(",")).join("\r\n") + "\r\n";
  }

  // Where the page may not use the clipboard, the text is shown, to be copied by hand.
  async function copy(text, button) {
    const status = button.nextElementSibling;
    try {
      await navigator.clipboard.writeText(text);
      status.textContent = "Copied.";
    } catch {
      const area = make("textarea", button.parentElement, { readonly: "", "aria-label": "CSV" });
      area.value = text;
      area.focus();
      area.select();
      status.textContent = "Copy the selected text.";
    }
  }

  // Draw the charts of a section, and let its buttons copy its tables.
  function show(element, key) {
    const source = element.querySelector(':scope > script[type="application/json"]');
    if (!source) return;
    const { tables, charts } = JSON.parse(source.textContent);
    const section = { key, views: [] };
    section.zoom = (range) => section.views.forEach((view) => view.zoom(range));
    section.toggle = (name) => section.views.forEach((view) => view.toggle(name));
    element.querySelectorAll("[data-chart]").forEach((holder) => {
      const spec = charts[Number(holder.dataset.chart)];
      section.views.push(new ChartView(section, spec, tables[spec.table], holder));
    });
    element.querySelectorAll("[data-csv]").forEach((button) =>
      button.addEventListener("click", () => copy(csv(tables[Number(button.dataset.csv)]), button)));
  }

  globalThis.sierra = { make, show, copy, csv, visible };
  document.querySelectorAll("section").forEach((element, place) => show(element, `section ${place}`));
})();
