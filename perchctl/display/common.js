"use strict";
// What all pages share. Each has these functions of its own: show(state), news(state): a text and
// whether it is good, clear() before the last card, found() once perchctl answers again, and
// showOrders(orders); and HANGS, what it means that perchctl answers with old numbers.
const by = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token") || "";
const TERMINAL = "On the terminal: Press Ctrl-C to land. Press it again to cut the motors.";
// Older browsers have no such bound: better no bound than a button that throws.
const within = (ms) => AbortSignal.timeout ? { signal: AbortSignal.timeout(ms) } : {};
const OLD_S = 2, TIMEOUT_MS = 1500, ORDER_TIMEOUT_MS = 3000;
let up = true, orders = "none", known = "none", failure = "";
// When the last answer came, how old its numbers were then (0: none are due), and whether it is over.
let heard = performance.now(), age = 0, silent = false, ended = false;

// By itself, four times a second: a program that hangs, or is suspended, answers nothing.
function watch() {
  if (ended) return;
  const quiet = age + (performance.now() - heard) / 1000;
  const old = quiet >= OLD_S;
  document.body.classList.toggle("old", old);
  by("old").hidden = !old;
  if (!old) return;
  by("old").textContent = `no update for ${Math.floor(quiet)} s: ` + (silent || !up
    ? "perchctl does not answer, so these values are old." : HANGS);
}

function showCard(card) {
  ended = true;
  clear();
  document.body.classList.remove("old");
  by("old").hidden = true;
  by("card").hidden = false;
  by("card").className = card.good ? "good" : "";
  by("outcome").textContent = card.outcome;
  by("why").textContent = card.reason;
  fill("facts", card.rows);
  link("the flight is over: this is its last image", "");
  scrollTo(0, 0);
}

function fill(table, rows) {
  by(table).replaceChildren(...rows.map(([name, text, filled]) => {
    const row = document.createElement("tr");
    const head = document.createElement("th"), cell = document.createElement("td");
    head.scope = "row";
    head.textContent = name;
    // Numbers stand apart by more than one space: a line breaks there, or after a comma, and not
    // before a unit.
    cell.textContent = text.includes("  ") ? text.replace(/([^\s,]) (?=\S)/g, "$1\u00a0") : text;
    if (filled) {
      // The text beside it says the same to whoever cannot see it.
      const bar = document.createElement("span"), part = document.createElement("span");
      bar.className = "bar";
      part.className = filled.is_enough ? "enough" : "";
      part.style.marginLeft = `${100 * filled.start}%`;
      part.style.width = `${100 * (filled.end - filled.start)}%`;
      bar.append(part);
      cell.prepend(bar, " ");
    }
    row.append(head, cell);
    return row;
  }));
}

function link(text, kind) {
  by("link").textContent = text;
  by("link").className = kind;
}

async function poll() {
  try {
    const answer = await fetch("state",
      { cache: "no-store", ...within(TIMEOUT_MS) });
    const state = await answer.json();
    heard = performance.now();
    age = state.age_s || 0;
    silent = false;
    document.title = by("title").textContent = state.title;
    showOrders(state.orders);
    known = orders;
    show(state);
    const old = state.age_s === null ? "" : `, ${state.age_s.toFixed(1)} s old`;
    const [text, good] = news(state);
    link(`${text}${old}`, good ? "up" : "down");
    if (state.card) {
      showCard(state.card);
      return;
    }
    if (!up) found();
    up = true;
  } catch (error) {
    silent = error.name === "TimeoutError";
    link(silent ? "perchctl does not answer"
      : "perchctl has stopped or cannot be reached; these are its last values", "down");
    // One that is late may still hear an order, also one that was gone before.
    if (orders !== "none" && orders !== "over") showOrders(silent ? known : "gone");
    up = false;
  }
  setTimeout(poll, up ? 150 : 1000);
}

// No order waits for the answer to another one.
const sending = new Set();
async function send(name, accepted) {
  if (sending.has(name)) return;
  sending.add(name);
  try {
    const answer = await fetch(name,
      { method: "POST", headers: { "X-Perchctl-Token": token },
        ...within(ORDER_TIMEOUT_MS) });
    failure = answer.ok ? "" : await answer.text();
    if (answer.ok) accepted();
  } catch {
    failure = "The order did not reach perchctl: press Ctrl-C on its terminal.";
  }
  if (failure) showOrders(orders);
  sending.delete(name);
}
