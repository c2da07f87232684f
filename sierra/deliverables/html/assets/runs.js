"use strict";
// The table of runs. It shows a few rows of a list that may have a million: as many as fit, from the place of the scroll bar.
// The rows of a window come from the server, and the elements of the rows stay, so that the focus is never lost.
(() => {
  const { make, show, visible } = globalThis.sierra;
  const { ask, guarded, of, say, counted, remember, open, view } = globalThis.sierra.explorer;
  const ROW = 32, HIGHEST = 8e6;  // pixels; no browser shows much higher elements
  const MARGIN = 80;  // the rows before the first visible one in a window
  const ID = 64;
  const IDS = ["run", "batch", "experiment"];
  const state = { columns: [], order: view.get("order") ?? "", descending: view.has("descending"), ticked: new Set(view.get("ticked")?.split(",").filter(Boolean)), run: view.get("run") ?? "", choices: null, window: null, asking: false, wanted: null, version: 0, opened: 0 };
  const frame = of("runs-window"), form = of("choice").elements;
  form.where.value = view.get("where") ?? "";
  let where = form.where.value;
  let rows = [];

  const short = (id) => id.slice(0, 10);
  const parts = (key) => { const output = Object.keys(state.choices.outputs).find((name) => key.startsWith(`${name}.`)); return output ? [output, key.slice(output.length + 1)] : ["", key]; };

  function save() {
    remember({ where, order: state.order, descending: state.descending ? "1" : "", columns: view.has("columns") ? JSON.stringify(state.columns) : "", ticked: [...state.ticked].join(","), run: state.run });
  }

  // Show a value: ids are short, numbers have 6 digits.
  function written(key, value) {
    if (value === null || value === undefined) return "";
    if (IDS.includes(key)) return short(value);
    if (key === "started" && typeof value === "string") return value.slice(0, 19);
    return typeof value === "number" && !Number.isInteger(value) ? String(Number(value.toPrecision(6))) : visible(value);
  }

  // Ask for the columns. If they are still the same, the elements of the table stay, and with them the focus.
  async function start() {
    const before = JSON.stringify(state.choices);
    if (!state.choices) say("Reading the runs …");
    const found = await guarded(of("runs-error"), () => ask("columns"));
    if (!state.choices) say("");
    if (!found || JSON.stringify(found) === before) return Boolean(found);
    state.choices = found;
    const known = new Set([...found.own, ...Object.entries(found.outputs).flatMap(([name, columns]) => columns.map((one) => `${name}.${one}`))]);
    let chosen = null;
    try { chosen = JSON.parse(view.get("columns")); } catch { view.delete("columns"); }
    const columns = (Array.isArray(chosen) ? chosen : found.default).filter((key) => known.has(key));
    const same = JSON.stringify(columns) === JSON.stringify(state.columns);
    state.columns = columns;
    listColumns();
    if (!same || !of("runs-head").firstChild) head();
    return true;
  }

  // Columns

  function listColumns() {
    const place = of("columns-choice");
    place.replaceChildren();
    const { own, variables, outputs } = state.choices;
    group("Runs", own.filter((key) => !variables.includes(key) && key !== "run"));
    group("Variables", variables);
    for (const [name, columns] of Object.entries(outputs)) group(`Final values of ${name}`, columns.map((one) => `${name}.${one}`));
    const curve = of("curve"), before = curve.value;
    curve.replaceChildren();
    for (const [name, columns] of Object.entries(outputs)) for (const one of columns) make("option", curve, { value: `${name}.${one}` }, `${name}.${one}`);
    if (before || state.choices.curve) curve.value = before || state.choices.curve;
  }

  function group(title, keys) {
    if (!keys.length) return;
    const set = make("fieldset", of("columns-choice"));
    make("legend", set, { dir: "auto" }, title);
    for (const key of keys) {
      const label = make("label", set, { class: "box" });
      const box = make("input", label, { type: "checkbox" });
      box.checked = state.columns.includes(key);
      make("span", label, { dir: "auto" }, parts(key)[1]);
      box.addEventListener("change", () => {
        state.columns = box.checked ? [...state.columns, key] : state.columns.filter((one) => one !== key);
        view.set("columns", JSON.stringify(state.columns));
        head();
        fetchRows({ fresh: true });
      });
    }
  }

  function head() {
    const line = of("runs-head");
    line.replaceChildren();
    make("span", make("th", line, { scope: "col" }), { class: "heard" }, "Ticked");
    for (const key of ["run", ...state.columns.filter((one) => one !== "run")]) {
      const sorted = state.order === key;
      const cell = make("th", line, { scope: "col", dir: "auto", "data-key": key, "aria-sort": sorted ? (state.descending ? "descending" : "ascending") : "none" });
      const button = make("button", cell, { type: "button", class: "sort" }, key);
      make("span", button, { "aria-hidden": "true" }, sorted ? (state.descending ? " ▼" : " ▲") : "");
      button.addEventListener("click", () => sort(key));
    }
    rows = [];
    of("runs-rows").replaceChildren();
  }

  // Sort by a column: first ascending, then descending, then in the order of batches.
  function sort(key) {
    if (state.order !== key) Object.assign(state, { order: key, descending: false });
    else if (!state.descending) state.descending = true;
    else Object.assign(state, { order: "", descending: false });
    head();
    of("runs-head").querySelector(`[data-key="${CSS.escape(key)}"] button`).focus();
    fetchRows({ fresh: true, top: true });
  }

  // Rows

  const fitting = () => Math.max(1, Math.floor((frame.clientHeight - of("runs-head").offsetHeight) / ROW));

  function firstVisible() {
    const total = state.window?.total ?? 0, room = frame.scrollHeight - frame.clientHeight;
    const last = Math.max(0, total - fitting());
    return room <= 0 ? 0 : Math.min(last, Math.round((frame.scrollTop / room) * last));
  }

  function scrollTo(first) {
    const last = Math.max(1, state.window.total - fitting());
    frame.scrollTop = (Math.min(Math.max(first, 0), last) / last) * (frame.scrollHeight - frame.clientHeight);
  }

  // Ask for the window around the first visible row. Only the last wish is asked once the answer before it is there.
  async function fetchRows({ fresh = false, top = false } = {}) {
    if (fresh) state.version += 1;
    if (top) frame.scrollTop = 0;
    state.wanted = Math.max(0, firstVisible() - MARGIN);
    if (state.asking) return;
    state.asking = true;
    try {
      while (state.wanted !== null) {
        const version = state.version, first = state.wanted;
        state.wanted = null;
        const question = { where, order: state.order, descending: state.descending, columns: state.columns, first };
        const found = await guarded(of("runs-error"), () => ask("runs", question));
        if (version !== state.version) state.wanted ??= first;
        else if (found) accept(found);
      }
    } finally { state.asking = false; }
  }

  function accept(found) {
    state.window = { ...found, mine: new Set(found.mine) };
    of("runs-height").style.height = `${Math.min(found.total * ROW, HIGHEST) + of("runs-head").offsetHeight}px`;
    const counts = Object.entries(found.counts).map(([status, count]) => `${count.toLocaleString()} ${status}`);
    if (found.executing) counts.push(`${found.executing.toLocaleString()} being executed now`);
    of("runs-count").textContent = `${counted(found.total, "row")}${counts.length ? `: ${counts.join(", ")}` : ""}`;
    save();
    render();
  }

  function render() {
    if (!state.window) return;
    const { total, first: begin, columns, numeric, rows: values, mine } = state.window;
    const first = firstVisible(), count = Math.min(fitting(), total - first);
    while (rows.length < count) rows.push(line(rows.length));
    rows.forEach((row, k) => {
      row.element.hidden = k >= count;
      if (k >= count) return;
      const at = first + k, data = values[at - begin];
      const id = data?.[0] ?? "";
      row.id = id;
      row.element.setAttribute("aria-rowindex", String(at + 2));
      row.box.checked = state.ticked.has(id);
      row.box.disabled = row.button.disabled = !id;
      row.box.setAttribute("aria-label", `Tick run ${short(id)}, row ${at + 1}`);
      row.button.textContent = id ? short(id) : "…";
      row.button.toggleAttribute("aria-current", id !== "" && id === state.run);
      row.cells.forEach((cell, column) => {
        const key = row.keys[column], place = columns.indexOf(key), value = data && place >= 0 ? data[place + 1] : "";
        const executing = key === "status" && mine.has(id);
        cell.className = numeric.includes(key) ? "number" : "";
        if (key === "status") cell.dataset.status = executing ? "executing" : String(value);
        fill(cell, key, executing ? "executing" : value);
      });
    });
    for (const cell of of("runs-head").children) cell.classList.toggle("number", numeric.includes(cell.dataset.key));
    of("runs").setAttribute("aria-rowcount", String(total + 1));
    if (total && (first < begin || first + count > begin + values.length) && !state.asking) fetchRows();
  }

  function fill(cell, key, value) {
    const shown = written(key, value);
    if (key !== "batch") cell.textContent = shown;
    else if (cell.firstChild) Object.assign(cell.firstChild, { textContent: shown, value });
    else make("button", cell, { type: "button", class: "link", value }, shown).addEventListener("click", (event) => open("batches", event.target.value));
    cell.title = typeof value === "string" && value.length > 12 ? visible(value) : "";
  }

  function line(place) {
    const element = make("tr", of("runs-rows"));
    const box = make("input", make("td", element), { type: "checkbox" });
    const button = make("button", make("th", element, { scope: "row" }), { type: "button", class: "link" });
    const keys = state.columns.filter((one) => one !== "run");
    const row = { element, box, button, keys, id: "", cells: keys.map(() => make("td", element, { dir: "auto" })) };
    box.addEventListener("change", () => tick(row.id, box.checked));
    button.addEventListener("click", () => openRun(row.id));
    element.addEventListener("keydown", (event) => step(event, place));
    return row;
  }

  // Arrow keys move the focus to the same field of the next row, and scroll at the ends.
  function step(event, place) {
    const by = { ArrowDown: 1, ArrowUp: -1, PageDown: fitting(), PageUp: -fitting() }[event.key];
    if (!by && event.key !== "Home" && event.key !== "End") return;
    event.preventDefault();
    const field = event.target.matches("input") ? "box" : "button", count = rows.filter((row) => !row.element.hidden).length;
    if (event.key === "Home") scrollTo(0);
    else if (event.key === "End") scrollTo(state.window.total);
    else if (Math.abs(by) > 1 || place + by < 0 || place + by >= count) scrollTo(firstVisible() + by);
    else rows[place + by][field].focus();
  }

  function tick(run, on) {
    if (on) state.ticked.add(run);
    else state.ticked.delete(run);
    ticked();
    save();
    render();
  }

  function ticked() {
    of("ticked").textContent = state.ticked.size ? `${counted(state.ticked.size, "run")} ticked` : "Tick runs to compare their curves and their differences.";
    of("compare").disabled = state.ticked.size < 2;
    of("untick").disabled = state.ticked.size === 0;
  }

  // Ticked runs

  async function compare({ focus = true } = {}) {
    const runs = [...state.ticked];
    of("compared").hidden = false;
    if (focus) of("compared-title").focus();
    await drawCurves();
    of("differences").replaceChildren();
    const found = await guarded(of("differ-error"), () => ask("differ", { runs }));
    for (const { run, lines } of found ?? []) text(of("differences"), `Differences of run ${short(run)}`, lines.join("\n"));
  }

  async function drawCurves() {
    const column = of("curve").value, runs = [...state.ticked];
    of("curves").replaceChildren();
    if (!column) return void (of("curves-error").textContent = "The runs have no output with numbers.");
    const found = await guarded(of("curves-error"), () => ask("curves", { runs, column }), () => column === of("curve").value);
    if (!found) return;
    of("curves").innerHTML = found.section;  // the server has escaped it
    for (const section of of("curves").children) show(section, "curves");
  }

  // One run

  async function openRun(run, { focus = true } = {}) {
    const mine = ++state.opened, wanted = () => mine === state.opened;
    state.run = run;
    save();
    render();
    of("run").hidden = false;
    of("run-title").textContent = `Run ${short(run)}`;
    for (const id of ["why", "run-files", "run-record"]) of(id).replaceChildren();
    if (focus) of("run-title").focus();
    const found = await guarded(of("run-error"), () => ask("run", { run }), wanted);
    if (!found) return;
    const { files, executions, kind, ...rest } = found;
    for (const one of executions) if (one.log_tail) log(of("run-record"), `End of the log of execution ${short(one.execution)}`, one.log_tail);
    showFiles(run, files);
    record(of("run-record"), "Executions", executions.map(({ log_tail, ...one }) => one));
    for (const [name, value] of Object.entries(rest)) if (value !== null && typeof value === "object") record(of("run-record"), name, value);
    facts(of("run-record"), Object.entries(rest).filter(([, value]) => value === null || typeof value !== "object"), { first: true });
  }

  // Show a text of several lines, which scrolls if it is long.
  function text(place, title, content) {
    make("pre", make("div", place, { class: "scroll", tabindex: "0", role: "group", "aria-label": title }), { dir: "auto" }, content);
  }

  function log(place, title, content) {
    make("h3", place, { dir: "auto" }, title);
    text(place, title, content);
  }

  function facts(place, entries, { first = false } = {}) {
    const list = make("dl", place, { class: "facts" });
    for (const [name, value] of entries) {
      if (value === null || value === "") continue;
      const pair = make("div", list);
      make("dt", pair, { dir: "auto" }, name);
      make("dd", pair, { dir: "auto" }, typeof value === "object" ? JSON.stringify(value) : String(value));
    }
    if (first) place.prepend(list);
  }

  // A part of a record: facts by name, a list of texts, or a table.
  function record(place, title, value) {
    const list = Array.isArray(value) ? value : null;
    if (list?.length === 0) return;
    make("h3", place, {}, title);
    if (!list) return facts(place, Object.entries(value));
    if (list.some((one) => one === null || typeof one !== "object")) return void make("p", place, { class: "code", dir: "auto" }, list.join(" "));
    const names = [...new Set(list.flatMap(Object.keys))].filter((name) => list.some((one) => one[name] !== null));
    const table = make("table", make("div", place, { class: "scroll", tabindex: "0", role: "group", "aria-label": title }));
    const line = make("tr", make("thead", table));
    for (const name of names) make("th", line, { scope: "col", dir: "auto" }, name);
    const body = make("tbody", table);
    for (const one of list) {
      const line = make("tr", body);
      for (const name of names) {
        const cell = one[name], shown = typeof cell === "string" && /^[0-9a-f]{64}$/.test(cell) ? short(cell) : cell === null ? "" : typeof cell === "object" ? JSON.stringify(cell) : String(cell);
        make("td", line, { class: typeof cell === "number" ? "number" : "", dir: "auto" }, shown);
      }
    }
  }

  function showFiles(run, files) {
    const place = of("run-files");
    if (!files.length) return;
    make("h3", place, {}, "Inputs, logs and recorded files");
    const list = make("ul", place, { class: "files" });
    for (const file of files) {
      const item = make("li", list);
      make("button", item, { type: "button", class: "link", dir: "auto" }, file.path).addEventListener("click", () => showFile(run, file.path));
      make("small", item, { dir: "auto" }, ` ${[file.kind, file.bytes === null ? "" : counted(file.bytes, "byte"), file.remark].filter(Boolean).join(", ")}`);
    }
    make("div", place, { id: "run-file", "aria-live": "polite" });
  }

  async function showFile(run, path) {
    const place = of("run-file");
    place.replaceChildren();
    const found = await guarded(of("run-error"), () => ask("file", { run, path }), () => state.run === run);
    if (!found) return;
    log(place, path, found.text);
    const part = found.shown < found.bytes ? `The first ${found.shown.toLocaleString()} of ${counted(found.bytes, "byte")}. ` : "";
    make("p", place, { class: "note", dir: "auto" }, `${part}${found.remark ? `${found.remark}. ` : ""}${found.command}`);
  }

  async function why() {
    const run = state.run;
    const found = await guarded(of("run-error"), () => ask("why", { run }), () => state.run === run);
    of("why").replaceChildren();
    if (found) text(of("why"), "Reasons of its executions", found.join("\n"));
  }

  function closeRun() {
    const run = state.run;
    state.opened += 1;
    state.run = "";
    of("run").hidden = true;
    save();
    render();
    (rows.find((row) => row.id === run)?.button ?? frame).focus();
  }

  of("choice").addEventListener("submit", (event) => {
    event.preventDefault();
    where = form.where.value;
    fetchRows({ fresh: true, top: true });
  });
  let scheduled = 0;
  frame.addEventListener("scroll", () => { scheduled ||= requestAnimationFrame(() => { scheduled = 0; render(); }); });
  new ResizeObserver(render).observe(frame);
  of("compare").addEventListener("click", () => compare());
  of("curve").addEventListener("change", drawCurves);
  of("untick").addEventListener("click", () => { state.ticked.clear(); of("compared").hidden = true; ticked(); save(); render(); });
  of("close-run").addEventListener("click", closeRun);
  of("ask-why").addEventListener("click", why);
  ticked();

  globalThis.sierra.runs = {
    // Show the table; the first time also the runs of the link.
    open: async () => {
      if (state.choices) return fetchRows({ fresh: true });
      if (!(await start())) return;
      await fetchRows({ fresh: true });
      if (state.run) openRun(state.run, { focus: false });
      if (state.ticked.size > 1) compare({ focus: false });
    },
    // Show what has been recorded since; the place in the list stays.
    changed: async () => { if (await start()) await fetchRows({ fresh: true }); },
  };
})();
