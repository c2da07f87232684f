"use strict";
// Asks the server, and fills the page with its answers. All texts of the store become text nodes, never HTML; the only HTML
// that is inserted is that of a chart's section, which the server has escaped.
(() => {
  const { make, show, copy, csv, visible } = globalThis.sierra;
  const [token, ...link] = location.hash.slice(1).split("&");
  const view = new URLSearchParams(link.join("&"));  // the view that the address describes
  const of = (id) => document.getElementById(id);
  const WORDS = ["SELECT", "FROM", "WHERE", "GROUP BY ALL", "ORDER BY", "LIMIT", "JOIN", "USING", "avg(", "count(*)", "max(", "min(", "DESCRIBE"];
  const FIELDS = ["x", "series", "facet", "where", "center", "band"];
  const SUBJECT = ["sql", "kind", "column", "log_y"];
  const DEFAULTS = { center: "mean", band: "ci" };
  const SILENT = ["state", "progress"];  // questions that can be asked while another one is answered
  const EVERY = 5000;
  const TOLD = 500;
  const PAUSE = 150;
  const page = { batches: [], first: 0, found: 0, batch: null, together: new Map(), tables: {}, outputs: [], variables: [], state: "", asking: 0, choosing: 0, drawing: 0, answering: 0, drawn: null, chosen: null };

  async function ask(name, content = {}) {
    page.asking += SILENT.includes(name) ? 0 : 1;
    of("stop").disabled = page.asking === 0;
    try {
      const answer = await fetch(`/ask/${name}`, {
        method: "POST",
        headers: { "Content-Type": "application/json", "X-Sierra-Token": token },
        body: JSON.stringify(content),
      });
      const found = await answer.json();
      if (!answer.ok) throw new Error(found.error);
      return found;
    } catch (error) {
      throw error instanceof TypeError ? new Error("The server has ended. Start it again with: sierra explore") : error;
    } finally {
      page.asking -= SILENT.includes(name) ? 0 : 1;
      of("stop").disabled = page.asking === 0;
    }
  }

  // Do something, and show its error at a place of the page. What is not wanted any more when it is done is null.
  async function guarded(place, work, wanted = () => true) {
    place.textContent = "";
    try {
      const found = await work();
      return wanted() ? found : null;
    } catch (error) {
      if (wanted()) place.textContent = visible(error.message);
      return null;
    }
  }

  const say = (text) => { of("status").textContent = text; };

  const counted = (count, one, several = `${one}s`) => `${count.toLocaleString()} ${count === 1 ? one : several}`;

  // Batches

  // Show a part of the list, which the server filters: there may be ten thousand batches.
  async function listBatches({ first = 0, again = false } = {}) {
    const words = of("filter").value;
    const found = await guarded(of("batch-error"), () => ask("batches", { words, first, again }));
    if (!found || words !== of("filter").value) return false;
    Object.assign(page, { batches: found.batches, first, found: found.found });
    const list = of("batches");
    list.replaceChildren();
    found.batches.forEach((one, place) => {
      const entry = make("div", list, { role: "option", id: `batch-${one.batch}`, "data-batch": one.batch, dir: "auto" }, one.query);
      make("small", entry, {}, [one.batch.slice(0, 10), ...one.groups, one.requested, counted(one.runs, "run"), one.state].join(", "));
      entry.setAttribute("aria-posinset", String(first + place + 1));
      entry.setAttribute("aria-setsize", String(found.found));
      entry.addEventListener("click", () => choose(one.batch));
    });
    markChosen();
    const shown = found.batches.length;
    const part = shown < found.found ? `${(first + 1).toLocaleString()} to ${(first + shown).toLocaleString()} of ` : "";
    of("left-out").textContent = `${part}${counted(found.found, "batch", "batches")}${found.found < found.all ? ` of ${found.all.toLocaleString()} in all` : ""}, the newest first`;
    of("newer").disabled = first === 0;
    of("older").disabled = first + shown >= found.found;
    return true;
  }

  // Mark the chosen batch, which may be in another part of the list.
  function markChosen() {
    const list = of("batches");
    for (const one of list.children) one.setAttribute("aria-selected", String(one.dataset.batch === page.batch));
    const entry = of(`batch-${page.batch}`);
    if (entry) list.setAttribute("aria-activedescendant", entry.id);
    else list.removeAttribute("aria-activedescendant");
    entry?.scrollIntoView({ block: "nearest" });
  }

  async function turn(by) {
    const first = Math.max(0, page.first + by * Math.max(page.batches.length, 100));
    if (await listBatches({ first })) of("batches").scrollTop = 0;
  }

  async function stepBatch(by) {
    let shown = page.batches.map((one) => one.batch);
    const at = shown.indexOf(page.batch);
    if (at >= 0 && by === 1 && at === shown.length - 1 && !of("older").disabled) {
      await turn(1);
      shown = page.batches.map((one) => one.batch);
      return choose(shown[0]);
    }
    if (at === 0 && by === -1 && !of("newer").disabled) {
      await turn(-1);
      shown = page.batches.map((one) => one.batch);
      return choose(shown.at(-1));
    }
    const next = Math.min(Math.max(at + by, 0), shown.length - 1);
    if (shown[next]) choose(shown[next], PAUSE);
  }

  // Show a batch. While a key is held down, the server is only asked about the batch at which it stays for a moment.
  async function choose(batch, pause = 0) {
    page.batch = batch;
    remember({ batch });
    markChosen();
    of("batch").hidden = false;
    const listed = page.batches.find((other) => other.batch === batch);
    if (listed) describe(listed, 0);
    closeReport();
    clearDrawn();
    of("figures").replaceChildren(document.createTextNode("Looking for figures …"));
    of("batch-notes").replaceChildren();
    of("videos").replaceChildren();
    const mine = ++page.choosing;
    const wanted = () => mine === page.choosing;
    if (pause) await new Promise((done) => setTimeout(done, pause));
    if (!wanted()) return;
    const [found, tables] = await Promise.all([
      guarded(of("batch-error"), () => ask("batch", { batch }), wanted),
      guarded(of("sql-error"), () => ask("tables", { batch }), wanted),
    ]);
    if (!wanted()) return;
    if (tables) listTables(tables);
    of("figures").replaceChildren();
    if (!found) return;
    describe(found.facts, found.executing);
    showVideos(found.videos);
    page.variables = found.variables;
    fillChoices();
    for (const [name, keys] of Object.entries(found.figures))
      make("button", of("figures"), { type: "button" }, name).addEventListener("click", () => draw(name, keys));
    for (const note of found.notes) make("p", of("batch-notes"), { class: "note", dir: "auto" }, note);
    const [first] = Object.entries(found.figures);
    if (first) draw(...first);
  }

  function describe(one, executing) {
    const id = one.batch.slice(0, 10);
    page.query = one.query;
    of("batch-title").textContent = visible(one.query);
    const running = executing ? `${executing} being executed now, ` : "";
    of("facts").textContent = `batch ${id}: ${counted(one.experiments, "experiment")}, ${counted(one.runs, "run")}, ${running}${one.state}; sierra replay ${id}`;
    of("add").disabled = page.together.has(one.batch);
  }

  function showVideos(found) {
    if (!found.length) return;
    const details = make("details", of("videos"));
    make("summary", details, {}, `Videos (${found.length})`);
    const shelf = make("div", details, { class: "films" });
    details.addEventListener("toggle", () => {
      if (details.open && !shelf.firstChild) for (const one of found) showVideo(shelf, one);
    });
    details.open = found.length <= 2;
  }

  function showVideo(shelf, { name, file, address, picture, problem }) {
    const figure = make("figure", shelf);
    if (problem) return void make("p", figure, { class: "note", dir: "auto" }, `Video ${name}: ${problem}.`);
    if (picture) {
      const details = make("details", figure);  // a GIF would play for ever
      make("summary", details, {}, "Play the GIF; close it to stop");
      make("img", details, { src: address, alt: `Video ${name}` });
    } else make("video", figure, { src: address, controls: "", loop: "", preload: "metadata", "aria-label": `Video ${name}` });
    make("figcaption", figure, { dir: "auto" }, `${name} (${file})`);
  }

  // The report: the page that `sierra report` writes, in a frame of its own

  function closeReport() {
    of("told").hidden = true;
    of("frame").removeAttribute("src");
  }

  async function report() {
    const [button, batch] = [of("report"), page.batch];
    button.disabled = true;
    say("Making the report …");
    const told = setInterval(async () => {
      const part = await ask("progress").catch(() => "");
      if (button.disabled && part) say(`Making the report: ${visible(part)} …`);
    }, TOLD);
    const found = await guarded(of("batch-error"), () => ask("report", { batch }), () => page.batch === batch);
    clearInterval(told);
    button.disabled = false;
    say(found ? "The report is below." : "");
    if (!found) return;
    of("told").hidden = false;
    of("alone").href = found.address;
    of("frame").src = found.address;
    of("report-notes").textContent = visible(found.notes.join("; "));
    of("told").scrollIntoView();
  }

  // The frame is as high as its content, so that there is one scroll bar only.
  function fit() {
    const inner = of("frame").contentDocument?.body;
    if (inner) new ResizeObserver(() => { of("frame").height = inner.offsetHeight; }).observe(inner);
  }

  // Several batches

  function add() {
    page.together.set(page.batch, page.query);
    of("add").disabled = true;
    listTogether();
  }

  function listTogether() {
    of("together").hidden = page.together.size === 0;
    of("chosen").replaceChildren();
    for (const [batch, query] of page.together) {
      const item = make("li", of("chosen"), { dir: "auto" }, `${query} (${batch.slice(0, 10)}) `);
      const button = make("button", item, { type: "button", "aria-label": `Remove ${query} (${batch.slice(0, 10)})` }, "Remove");
      button.addEventListener("click", () => {
        page.together.delete(batch);
        of("add").disabled = page.together.has(page.batch);
        listTogether();
        (of("chosen").querySelector("button") ?? of("add")).focus();
      });
    }
    for (const id of ["draw-together", "test"]) of(id).disabled = page.together.size < 2;
  }

  async function test() {
    const field = form();
    const keys = field.table.value ? { table: field.table.value } : {};
    const [column] = keysOfForm().column === undefined ? [] : [].concat(keysOfForm().column);
    if (column) keys.column = column;
    const name = field.name.value || "my_comparison";
    const found = await drawn(of("together-error"), () => ask("compare", { batches: [...page.together.keys()], name, keys }));
    if (!found) return;
    for (const button of of("drawn").querySelectorAll(".copy"))
      button.addEventListener("click", () => copy(button.closest(".code").querySelector("pre").textContent, button));
  }

  // Tables

  function listTables({ of_runs, of_store }) {
    page.tables = { ...of_runs, ...of_store };
    page.outputs = Object.keys(of_runs);
    of("tables").replaceChildren();
    nameTables(of("tables"), of_runs);
    const own = make("details", of("tables"));
    make("summary", own, {}, "Records of the store");
    nameTables(make("div", own), of_store);
    fillChoices();
  }

  function nameTables(place, tables) {
    for (const [name, columns] of Object.entries(tables)) {
      const row = make("div", place, { class: "table" });
      const details = make("details", row);
      make("summary", details, { dir: "auto" }, name);
      const button = make("button", row, { type: "button", "aria-label": `Insert ${name}` }, "Insert");
      button.addEventListener("click", () => insert(quoted(name)));
      const list = make("ul", details);
      for (const [column, kind] of columns) {
        const item = make("li", list);
        make("button", item, { type: "button", dir: "auto" }, column).addEventListener("click", () => insert(quoted(column)));
        make("small", item, {}, kind.toLowerCase());
      }
    }
  }

  const inQuotes = (name) => `"${name.replaceAll('"', '""')}"`;
  const quoted = (name) => (/^[a-z_][a-z0-9_]*$/i.test(name) ? name : inQuotes(name));

  function insert(text) {
    const area = of("statement");
    area.setRangeText(text, area.selectionStart, area.selectionEnd, "end");
    area.focus();
  }

  // Charts

  const form = () => of("chart").elements;

  function choices(select, names, chosen, first) {
    select.replaceChildren();
    if (first !== undefined) make("option", select, { value: "" }, first);
    for (const name of names) make("option", select, { value: name }, name);
    select.value = names.includes(chosen) ? chosen : select.options[0]?.value ?? "";
  }

  function fillChoices() {
    const { table, x, series, facet } = form();
    choices(table, page.outputs, table.value, "the statement below");
    for (const select of [x, series, facet]) choices(select, page.variables, select.value, "automatic");
    listColumns();
  }

  function listColumns() {
    const numbers = /INT|DOUBLE|FLOAT|DECIMAL/;
    const columns = (page.tables[form().table.value] ?? []).filter(([, kind]) => numbers.test(kind));
    of("columns").replaceChildren();
    for (const [name] of columns) make("option", of("columns"), {}, name);
  }

  // The names in the field of columns: one name as the list proposes it, or several with commas, in quotes if they have some.
  function columnsOf(text) {
    if ((page.tables[form().table.value] ?? []).some(([name]) => name === text)) return [text];
    const names = text.matchAll(/\s*(?:"((?:[^"]|"")*)"|([^,]+))\s*(?:,|$)/g);
    return [...names].map(([, quoted, bare]) => quoted?.replaceAll('""', '"') ?? bare.trim()).filter(Boolean);
  }

  function keysOfForm() {
    const field = form();
    const from = field.table.value ? { table: field.table.value } : { sql: of("statement").value };
    const keys = { ...kept(), ...(field.table.selectedIndex < 0 ? {} : from) };
    keys.kind = field.kind.value;
    const columns = columnsOf(field.column.value);
    if (columns.length) keys.column = columns.length === 1 ? columns[0] : columns;
    for (const name of FIELDS) {
      if (field[name].value) keys[name] = field[name].value;
      else if (field[name].selectedIndex >= 0) delete keys[name];
    }
    if (field.log_y.checked) keys.log_y = true;
    return keys;
  }

  const subject = () => JSON.stringify(["table", "kind", "column"].map((name) => form()[name].value));

  // The keys of the chosen figure that the form cannot show. They hold as long as it shows the same columns in the same way.
  const kept = () => (page.chosen?.subject === subject() ? page.chosen.kept : {});

  function toForm(name, keys) {
    const field = form();
    field.name.value = name;
    field.table.selectedIndex = -1;  // a declared figure need not name its table
    if (keys.table) field.table.value = keys.table;
    if (keys.sql) { field.table.value = ""; of("statement").value = visible(keys.sql); }
    field.kind.value = keys.kind ?? "timeseries";
    field.column.value = [].concat(keys.column ?? []).map((one) => (/[",]/.test(one) ? inQuotes(one) : one)).join(", ");
    for (const key of FIELDS) field[key].value = keys[key] === DEFAULTS[key] ? "" : keys[key] ?? "";
    field.log_y.checked = keys.log_y === true;
    listColumns();
    const shown = (key) => SUBJECT.includes(key) || (field[key] && (field[key].value || DEFAULTS[key]) === keys[key]);
    page.chosen = { subject: subject(), kept: Object.fromEntries(Object.entries(keys).filter(([key]) => !shown(key))) };
  }

  async function draw(name, keys, batches = [page.batch]) {
    toForm(name, keys);
    const [batch, ...others] = batches;
    const place = of(others.length ? "together-error" : "chart-error");
    const found = await drawn(place, () => ask("chart", { batch, name, keys, others }));
    if (!found) return;
    const more = Object.keys(page.chosen.kept).map(visible).join(", ");
    const changed = keys.sql && keys.sql !== visible(keys.sql) ? " Its statement has characters that control: below they are escapes." : "";
    const also = (more && ` The form does not show its keys ${more}.`) + changed;
    of("chart-of").textContent = `This chart shows ${others.length ? `${batches.length} batches` : `batch ${batch.slice(0, 10)}`}.${also}`;
  }

  function clearDrawn() {
    page.drawing += 1;
    page.chosen = null;
    of("drawn").replaceChildren();
    of("declaration").hidden = true;
    for (const id of ["chart-of", "chart-error", "together-error"]) of(id).textContent = "";
  }

  // Show what the server has drawn, and the lines that declare it.
  async function drawn(place, work) {
    const mine = ++page.drawing;
    const wanted = () => mine === page.drawing;
    of("drawn").toggleAttribute("data-stale", true);
    of("chart-of").textContent = "";
    const before = performance.now();
    const found = await guarded(place, work, wanted);
    if (!wanted()) return null;
    of("drawn").toggleAttribute("data-stale", false);
    if (!found) {
      of("drawn").replaceChildren();
      of("declaration").hidden = true;
      return null;
    }
    const { name, keys, file, kind } = found;
    page.drawn = { name, keys, file, kind };
    of("drawn").innerHTML = found.section;
    for (const section of of("drawn").children) show(section, "chart");
    of("toml").textContent = found.toml;
    of("command").textContent = visible(found.command);
    of("declaration").hidden = false;
    of("written").textContent = "";
    say(`Drawn in ${((performance.now() - before) / 1000).toFixed(2)} s.`);
    return found;
  }

  async function write() {
    const place = of("written");
    const found = await guarded(place, () => ask("write", page.drawn));
    if (!found) return;
    const only = page.drawn.kind === "figures" && found.figures.length === 1 ? " From now on, sierra draws this figure instead of the default ones." : "";
    place.textContent = `Written.${only}`;
  }

  // SQL

  async function answer() {
    of("words").hidden = true;
    const within = of("within").checked && page.batch ? page.batch : null;
    const mine = ++page.answering;
    const before = performance.now();
    const statement = of("statement").value;
    const found = await guarded(of("sql-error"), () => ask("query", { statement, batch: within }), () => mine === page.answering);
    if (mine !== page.answering) return;
    of("result").replaceChildren();
    if (!found) return;
    const took = ((performance.now() - before) / 1000).toFixed(2);
    const place = of("result");
    const count = `${found.more ? "the first " : ""}${found.rows.length.toLocaleString()} ${found.rows.length === 1 ? "row" : "rows"} of ${within ? `batch ${within.slice(0, 10)}` : "all batches"}`;
    const line = make("p", place, { class: "note" });
    make("span", line, { role: "status" }, `${count}, ${took} s `);
    const button = make("button", line, { type: "button" }, "Copy as CSV");
    make("span", line, { role: "status" });
    const columns = found.columns.map((_, k) => found.rows.map((row) => row[k]));
    button.addEventListener("click", () => copy(csv({ headers: found.columns, columns }), button));
    if (found.notes) make("p", place, { class: "note", dir: "auto" }, found.notes);
    const scroll = make("div", place, { class: "scroll", tabindex: "0", role: "group", "aria-label": "Answer" });
    const table = make("table", scroll);
    const head = make("tr", make("thead", table));
    for (const name of found.columns) make("th", head, { scope: "col", dir: "auto" }, name);
    const body = make("tbody", table);
    for (const row of found.rows) {
      const line = make("tr", body);
      row.forEach((value, k) => {
        const numeric = found.numeric.includes(found.columns[k]);
        make("td", line, numeric ? { class: "number" } : { dir: "auto" }, value === null ? "" : String(value));
      });
    }
  }

  // Completion of the word before the cursor by names of tables, of columns and of SQL.

  const TOKENS = /^(?:[^"']+|"(?:[^"]|"")*"(?!")|'(?:[^']|'')*'(?!'))*/;

  // The word before the cursor: a part of a name, or of a name in quotes with the first quote; none within a text.
  function wordOf(before) {
    const rest = before.replace(TOKENS, "");
    if (rest) return rest.startsWith('"') ? rest : "";
    return /[\p{L}\p{N}_]*$/u.exec(before)[0];
  }

  // All names with what they are: those of outputs come first.
  function names() {
    const found = new Map();
    const tables = Object.entries(page.tables);
    const parts = [tables.slice(0, page.outputs.length), tables.slice(page.outputs.length)];
    for (const part of parts) {
      for (const [table] of part) if (!found.has(table)) found.set(table, "table");
      for (const [table, columns] of part) for (const [name] of columns) if (!found.has(name)) found.set(name, `column of ${table}`);
    }
    return [...found];
  }

  function candidates(start) {
    const area = of("statement");
    const word = wordOf(area.value.slice(0, area.selectionStart));
    if (!word || word.length < start) return { word, found: [] };
    const open = word.startsWith('"');
    const low = (open ? word.slice(1).replaceAll('""', '"') : word).toLowerCase();
    const all = [...names().map(([name, kind]) => [name, open ? inQuotes(name) : quoted(name), kind]), ...(open ? [] : WORDS.map((name) => [name, name, ""]))];
    const fits = all.filter(([name]) => name.toLowerCase().startsWith(low) && (open || name.toLowerCase() !== low));
    return { word, found: fits.slice(0, 12).map(([, text, kind]) => [text, kind]) };
  }

  function propose(start) {
    const { word, found } = candidates(start);
    const list = of("words");
    list.replaceChildren();
    found.forEach(([name, kind], k) => {
      const item = make("li", list, { role: "option", id: `word-${k}`, "aria-selected": String(k === 0) }, `${name} `);
      make("small", item, {}, kind);
      item.addEventListener("mousedown", (event) => { event.preventDefault(); accept(word, name); });
    });
    list.hidden = found.length === 0;
    mark();
    return found.length > 0;
  }

  function mark() {
    const chosen = of("words").querySelector('[aria-selected="true"]');
    if (chosen && !of("words").hidden) of("statement").setAttribute("aria-activedescendant", chosen.id);
    else of("statement").removeAttribute("aria-activedescendant");
    chosen?.scrollIntoView({ block: "nearest" });
  }

  function accept(word, name) {
    const area = of("statement");
    const closed = word.startsWith('"') && area.value[area.selectionStart] === '"';
    area.setRangeText(name, area.selectionStart - word.length, area.selectionStart + Number(closed), "end");
    of("words").hidden = true;
    mark();
    area.focus();
  }

  function key(event) {
    const list = of("words");
    const items = [...list.children];
    const at = items.findIndex((one) => one.getAttribute("aria-selected") === "true");
    if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) answer();
    else if (list.hidden) return;
    else if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      items[at].setAttribute("aria-selected", "false");
      items.at((at + (event.key === "ArrowDown" ? 1 : -1)) % items.length).setAttribute("aria-selected", "true");
      mark();
    } else if (event.key === "Tab" || event.key === "Enter") {
      const { word, found } = candidates(1);
      accept(word, found[at][0]);
    } else if (event.key === "Escape") { list.hidden = true; mark(); } else return;
    event.preventDefault();
  }

  // The whole page

  // Write the view into the address, which shows the same again. An empty value is left out.
  function remember(values) {
    for (const [name, value] of Object.entries(values)) {
      if (value) view.set(name, value);
      else view.delete(name);
    }
    history.replaceState(null, "", `#${[token, view].filter(String).join("&")}`);
  }

  function open(name, batch) {
    const batches = name === "batches";
    of("batches-view").hidden = !batches;
    of("runs-view").hidden = batches;
    of("to-batches").setAttribute("aria-pressed", String(batches));
    of("to-runs").setAttribute("aria-pressed", String(!batches));
    remember({ view: batches ? "batches" : "", batch: batch ?? view.get("batch") });
    if (batch) page.batch = batch;
    return batches ? (batch || !page.state ? refresh() : null) : globalThis.sierra.runs.open();
  }

  const shows = (name) => !of(`${name}-view`).hidden;

  async function refresh() {
    const found = await guarded(of("chart-error"), () => ask("overview"));
    if (!found) return;
    page.state = found.state;
    of("write").hidden = !found.writes;
    choices(form().kind, found.kinds, form().kind.value);
    if (!(await listBatches({ first: page.first, again: true }))) return;
    say(`${counted(page.found, "batch", "batches")}.`);
    const chosen = page.batch ?? page.batches[0]?.batch;
    if (chosen) await choose(chosen);
    else listTables(await ask("tables"));
  }

  async function look() {
    if (document.hidden || page.asking) return;
    const state = await ask("state").catch((error) => { say(visible(error.message)); return ""; });
    if (state !== page.state) {
      page.state = state;
      if (!state) return;
      if (shows("runs")) await globalThis.sierra.runs.changed();
      else if (await listBatches({ first: page.first })) say("There are new records. Refresh shows them.");
    }
  }

  // A link would replace the token in the address.
  of("skip").addEventListener("click", (event) => { event.preventDefault(); of("main").focus(); });
  let typing = 0;
  of("filter").addEventListener("input", () => {
    clearTimeout(typing);
    typing = setTimeout(listBatches, PAUSE);
  });
  of("newer").addEventListener("click", () => turn(-1));
  of("older").addEventListener("click", () => turn(1));
  of("report").addEventListener("click", report);
  of("close-report").addEventListener("click", () => { closeReport(); of("report").focus(); });
  of("frame").addEventListener("load", fit);
  of("add").addEventListener("click", add);
  of("draw-together").addEventListener("click", () => draw(form().name.value || "my_figure", keysOfForm(), [...page.together.keys()]));
  of("test").addEventListener("click", test);
  of("batches").addEventListener("keydown", (event) => {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (by) { event.preventDefault(); stepBatch(by); }
  });
  of("refresh").addEventListener("click", () => (shows("runs") ? globalThis.sierra.runs.changed() : refresh()));
  of("to-runs").addEventListener("click", () => open("runs"));
  of("to-batches").addEventListener("click", () => open("batches"));
  addEventListener("hashchange", () => location.reload());
  of("stop").addEventListener("click", () => ask("stop").catch(() => null));
  of("chart").addEventListener("submit", (event) => { event.preventDefault(); draw(form().name.value || "my_figure", keysOfForm()); });
  form().table.addEventListener("change", listColumns);
  of("copy-toml").addEventListener("click", () => copy(of("toml").textContent, of("copy-toml")));
  of("write").addEventListener("click", write);
  of("sql").addEventListener("submit", (event) => { event.preventDefault(); answer(); });
  of("statement").addEventListener("input", () => propose(2));
  of("statement").addEventListener("keydown", key);
  of("statement").addEventListener("blur", () => { of("words").hidden = true; });
  page.batch = view.get("batch");
  globalThis.sierra.explorer = { ask, guarded, of, say, counted, remember, open, view };
  addEventListener("DOMContentLoaded", () => {
    setInterval(look, EVERY);
    open(view.get("view") ?? "runs");
  });
})();
