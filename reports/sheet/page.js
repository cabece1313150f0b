"use strict";
(() => {
  const sheet = JSON.parse(document.getElementById("sheet").textContent);
  const byId = (id) => document.getElementById(id);
  const asks = new Map(sheet.asks.map((ask) => [ask.name, ask]));
  const place = `su3d-bench sheet ${sheet.id} ${sheet.annotator}`;
  const [LONGEST_S, MAX_PACE, MIN_PACE] = [120, 30, 5]; // longer is a pause; answers in the mean, and needed for it
  const nTotal = sheet.items.reduce((n, item) => n + item.asks.length, 0);
  let answers = {}; // item id -> ask -> choice
  let comments = {}; // item id -> text
  let history = []; // [item id, {ask: choice before or null}]
  let pace = []; // seconds per answer, without pauses
  let since = Date.now(); // last answer
  let at = 0;
  let canSave = true;
  let isExported = true;

  const of = (item) => (Object.hasOwn(answers, item.id) ? answers[item.id] : {});
  const openAsk = (item) => item.asks.find((name) => !Object.hasOwn(of(item), name));
  const nDone = () => sheet.items.reduce((n, item) => n + item.asks.length - item.asks.filter((a) => !Object.hasOwn(of(item), a)).length, 0);

  function restore() {
    try {
      const kept = JSON.parse(localStorage.getItem(place) || "null");
      if (!kept || typeof kept !== "object") return;
      for (const item of sheet.items) {
        if (typeof kept.comments?.[item.id] === "string") comments[item.id] = kept.comments[item.id];
        const saved = kept.answers && kept.answers[item.id];
        if (!saved) continue;
        for (const name of item.asks) {
          if (Object.hasOwn(saved, name) && asks.get(name).choices.includes(saved[name])) {
            (answers[item.id] ||= {})[name] = saved[name];
          }
        }
      }
      if (Array.isArray(kept.history)) {
        const known = new Map(sheet.items.map((item) => [item.id, item]));
        const isKnown = ([id, before]) => before && Object.keys(before).every((name) => known.get(id)?.asks.includes(name));
        history = kept.history.filter((one) => Array.isArray(one) && isKnown(one));
      }
      if (Array.isArray(kept.pace)) pace = kept.pace.filter(Number.isFinite);
      if (Number.isInteger(kept.at)) at = Math.min(Math.max(kept.at, 0), sheet.items.length - 1);
    } catch {
      canSave = false;
    }
  }

  function save() {
    isExported = false;
    try {
      localStorage.setItem(place, JSON.stringify({ answers, comments, history, pace, at }));
      canSave = true;
    } catch {
      canSave = false;
    }
  }

  function choose(choices) {
    const item = sheet.items[at];
    const wasOpen = openAsk(item);
    history.push([item.id, Object.fromEntries(Object.keys(choices).map((name) => [name, of(item)[name] ?? null]))]);
    Object.assign((answers[item.id] ||= {}), choices);
    const seconds = (Date.now() - since) / 1000;
    const n = Object.keys(choices).length;
    if (seconds >= 0 && seconds < LONGEST_S) pace = [...pace, ...Array(n).fill(seconds / n)].slice(-MAX_PACE);
    since = Date.now();
    if (wasOpen && !openAsk(item)) at = Math.min(at + 1, sheet.items.length - 1);
    save();
    show();
  }

  // The first choice of every question is the favourable one.
  const markRight = () => choose(Object.fromEntries(sheet.items[at].asks.map((name) => [name, asks.get(name).choices[0]])));

  function undo() {
    const last = history.pop();
    if (!last) return;
    const [id, before] = last;
    for (const [name, choice] of Object.entries(before)) {
      if (choice === null) delete answers[id][name];
      else answers[id][name] = choice;
    }
    at = sheet.items.findIndex((item) => item.id === id);
    save();
    show();
  }

  function go(step) {
    at = Math.min(Math.max(at + step, 0), sheet.items.length - 1);
    save();
    show();
  }

  function goToOpen() {
    for (let k = 1; k <= sheet.items.length; k++) {
      const next = (at + k) % sheet.items.length;
      if (openAsk(sheet.items[next])) {
        at = next;
        save();
        return show();
      }
    }
  }

  const isLarge = () => byId("picture").classList.contains("large");
  function enlarge(isSo) {
    byId("picture").classList.toggle("large", isSo);
    byId("image").setAttribute("aria-pressed", String(isSo));
  }

  // On one line, and marked so that a spreadsheet does not read it as a formula.
  const commentOf = (item) =>
    (comments[item.id] || "").replace(/[\s\p{Cc}\p{Cs}]+/gu, " ").trim().replace(/^[=+\-@\uff1d\uff0b\uff0d\uff20]/u, "'$&");
  const cell = (text) => (/[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);

  function csv() {
    const rows = [sheet.columns];
    for (const item of sheet.items) {
      item.asks.forEach((name, k) => {
        const comment = k === 0 ? commentOf(item) : "";
        rows.push([sheet.id, item.id, sheet.annotator, name, of(item)[name] ?? "", item.check, comment]);
      });
    }
    return rows.map((row) => row.map(cell).join(",")).join("\n") + "\n";
  }

  function exportAnswers() {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([csv()], { type: "text/csv;charset=utf-8" }));
    link.download = `${sheet.id}.${sheet.annotator}.csv`;
    document.body.append(link);
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
    isExported = true;
    show();
  }

  function element(tag, text, className) {
    const made = document.createElement(tag);
    if (text !== undefined) made.textContent = text;
    if (className) made.className = className;
    return made;
  }

  function fieldOf(item, name, current) {
    const ask = asks.get(name);
    const field = element("fieldset", undefined, name === current ? "now" : "");
    field.append(element("legend", ask.text));
    const row = element("div", undefined, "choices");
    ask.choices.forEach((choice, k) => {
      const button = element("button");
      button.type = "button";
      if (name === current) button.append(element("kbd", String(k + 1)));
      button.append(element("span", choice));
      if (ask.meanings[k]) button.append(element("small", ask.meanings[k]));
      button.setAttribute("aria-pressed", String(of(item)[name] === choice));
      button.addEventListener("click", () => choose({ [name]: choice }));
      row.append(button);
    });
    field.append(row);
    return field;
  }

  function showInstructions() {
    const how = byId("how");
    how.append(...sheet.guide.map((sentence) => element("p", sentence)));
    for (const ask of sheet.asks) {
      how.append(element("h2", ask.text));
      const list = element("dl");
      ask.choices.forEach((choice, k) => list.append(element("dt", choice), element("dd", ask.meanings[k] || "")));
      how.append(list);
    }
  }

  const currentAsk = (item) => openAsk(item) || item.asks[0];

  function show() {
    const item = sheet.items[at];
    const done = nDone();
    byId("progress").max = nTotal;
    byId("progress").value = done;
    const minutes = (pace.reduce((a, b) => a + b, 0) / pace.length / 60) * (nTotal - done);
    const isTimed = pace.length >= MIN_PACE && done < nTotal;
    byId("left").textContent = isTimed ? `about ${Math.max(1, Math.round(minutes))} min left (estimate)` : "";
    byId("count").textContent = `${done} of ${nTotal} answered, item ${at + 1} of ${sheet.items.length}`;
    const image = byId("image");
    const [panel, fields] = [byId("panel"), byId("asks")];
    const hasFocus = fields.contains(document.activeElement);
    if (image.dataset.item !== item.id) {
      image.dataset.item = item.id;
      image.src = `data:image/jpeg;base64,${item.picture}`;
      enlarge(false);
      byId("picture").scrollTo(0, 0);
      panel.scrollTo(0, 0);
      byId("comment").value = comments[item.id] || "";
    }
    image.alt = `Picture of ${item.id}`;
    byId("text").textContent = item.text;
    fields.replaceChildren(...item.asks.map((name) => fieldOf(item, name, currentAsk(item))));
    const current = fields.querySelector(".now");
    if (hasFocus) current.querySelector("button").focus({ preventScroll: true });
    if (panel.scrollHeight > panel.clientHeight) current.scrollIntoView({ block: "nearest" }); // beside the picture
    byId("back").disabled = at === 0;
    byId("next").disabled = at === sheet.items.length - 1;
    byId("undo").disabled = history.length === 0;
    byId("open").disabled = !sheet.items.some((one, k) => k !== at && openAsk(one));
    byId("export").classList.toggle("ready", done === nTotal);
    const note = byId("note");
    note.classList.toggle("alarm", !canSave);
    if (!canSave) note.textContent = "Your browser cannot save progress; export before closing.";
    else if (done === nTotal) note.textContent = "All done. Export your answers and send us the file.";
    else note.textContent = "Answers are saved in this browser as you go.";
  }

  byId("back").addEventListener("click", () => go(-1));
  byId("next").addEventListener("click", () => go(1));
  byId("open").addEventListener("click", goToOpen);
  byId("undo").addEventListener("click", undo);
  byId("right").addEventListener("click", markRight);
  byId("comment").addEventListener("input", () => {
    comments[sheet.items[at].id] = byId("comment").value;
    save();
  });
  byId("export").addEventListener("click", exportAnswers);
  byId("image").addEventListener("click", () => enlarge(!isLarge()));
  byId("image").addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") enlarge(!isLarge());
    else if (event.key === "Escape" && isLarge()) enlarge(false);
    else if (!(event.key.startsWith("Arrow") && isLarge())) return;
    event.stopPropagation(); // the arrow keys scroll an enlarged picture
    if (!event.key.startsWith("Arrow")) event.preventDefault();
  });
  document.addEventListener("keydown", (event) => {
    if (event.target === byId("comment") && event.key === "Escape") event.target.blur();
    if (event.target === byId("comment") || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    const item = sheet.items[at];
    const name = currentAsk(item);
    const choice = asks.get(name).choices[Number(event.key) - 1];
    if (choice !== undefined) choose({ [name]: choice });
    else if (event.key === "a" || event.key === "A") markRight();
    else if (event.key === "c" || event.key === "C") byId("comment").focus();
    else if (event.key === "ArrowLeft") go(-1);
    else if (event.key === "ArrowRight") go(1);
    else if (event.key === "u" || event.key === "U") undo();
    else if (event.key === "n" || event.key === "N") goToOpen();
    else if (event.key === "z" || event.key === "Z") enlarge(!isLarge());
    else if (event.key === "h" || event.key === "H") byId("guide").open = !byId("guide").open;
    else return;
    event.preventDefault();
  });
  window.addEventListener("beforeunload", (event) => {
    if (!canSave && !isExported) event.preventDefault();
  });
  showInstructions();
  restore();
  show();
})();
