"use strict";
(() => {
  const sheet = JSON.parse(document.getElementById("sheet").textContent);
  const byId = (id) => document.getElementById(id);
  const asks = new Map(sheet.asks.map((ask) => [ask.name, ask]));
  const place = `su3d-bench sheet ${sheet.id} ${sheet.annotator}`;
  const nTotal = sheet.items.reduce((n, item) => n + item.asks.length, 0);
  let answers = {}; // item id -> ask -> choice
  let history = []; // [item id, ask, choice before or null]
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
        history = kept.history.filter((one) => Array.isArray(one) && known.get(one[0])?.asks.includes(one[1]));
      }
      if (Number.isInteger(kept.at)) at = Math.min(Math.max(kept.at, 0), sheet.items.length - 1);
    } catch {
      canSave = false;
    }
  }

  function save() {
    isExported = false;
    try {
      localStorage.setItem(place, JSON.stringify({ answers, history, at }));
      canSave = true;
    } catch {
      canSave = false;
    }
  }

  function choose(name, choice) {
    const item = sheet.items[at];
    const before = Object.hasOwn(of(item), name) ? of(item)[name] : null;
    history.push([item.id, name, before]);
    (answers[item.id] ||= {})[name] = choice;
    if (!openAsk(item) && before === null) {
      at = Math.min(at + 1, sheet.items.length - 1);
    }
    save();
    show();
  }

  function undo() {
    const last = history.pop();
    if (!last) return;
    const [id, name, before] = last;
    if (before === null) delete answers[id][name];
    else answers[id][name] = before;
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

  const cell = (text) => (/[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);

  function csv() {
    const rows = [sheet.columns];
    for (const item of sheet.items) {
      for (const name of item.asks) {
        rows.push([sheet.id, item.id, sheet.annotator, name, Object.hasOwn(of(item), name) ? of(item)[name] : "", item.check]);
      }
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
      button.addEventListener("click", () => choose(name, choice));
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
    byId("count").textContent = `${done} of ${nTotal} answered, item ${at + 1} of ${sheet.items.length}`;
    const image = byId("image");
    if (image.dataset.item !== item.id) {
      image.dataset.item = item.id;
      image.src = `data:image/png;base64,${item.picture}`;
      enlarge(false);
      byId("picture").scrollTo(0, 0);
    }
    image.alt = `Picture of ${item.id}`;
    byId("text").textContent = item.text;
    byId("asks").replaceChildren(...item.asks.map((name) => fieldOf(item, name, currentAsk(item))));
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
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    const item = sheet.items[at];
    const name = currentAsk(item);
    const choice = asks.get(name).choices[Number(event.key) - 1];
    if (choice !== undefined) choose(name, choice);
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
