// Buttons of commands, settings, and the lines that the server says.

const COMMANDS = [ // name, words, key, what it does
  ["home", "Back to start", "KeyH", "stand at the start again; the memory keeps what was seen: is it still there?"],
  ["undo", "Undo", "KeyU", "one frame back"],
  ["record", "Record", "KeyR", "begin a recording, or end and save it"],
  ["goal", "Take goal", "KeyG", "what is seen now becomes the goal"],
  ["plan", "Walk to goal", "KeyP", "the planner walks until it sees the goal"],
  ["stop", "Stop", "Escape", "the planner stops"],
  ["reset", "Reset", "", "begin again; what was imagined is forgotten"],
];
const FIELDS = ["steps", "guidance", "autoguidance", "seed"];
const NOTICE = 6000; // milliseconds
const MOST_LINES = 3;

class Controls {
  constructor(send) {
    this.send = send;
    this.state = {};
    addEventListener("keydown", event => this.pressed(event));
    for (const name of FIELDS) this.field(name);
    byId("ahead").onchange = event => send("settings", { ahead: event.target.checked });
    byId("another-seed").onclick = () => send("settings", { seed: Math.floor(Math.random() * 1e6) });
  }

  field(name) {
    const input = byId(name), now = byId(`${name}-now`);
    input.oninput = () => now && (now.textContent = input.value);
    input.onchange = () => (input.checkValidity() && input.value !== "" ? this.send("settings", { [name]: Number(input.value) }) : this.fill());
    if (input.type === "range") input.onpointerup = () => input.blur(); // the keys walk again
    input.onkeydown = event => void (["Enter", "Escape"].includes(event.key) && input.blur()); // false would stop the key
  }

  begin({ limits, actions, settings }) {
    for (const line of document.querySelectorAll("#lines .ended")) line.remove(); // why the session before has ended
    const taken = new Set(actions.flatMap(({ keys }) => keys));
    this.keys = Object.fromEntries(COMMANDS.filter(([, , key]) => key && !taken.has(key)).map(([name, , key]) => [key, name]));
    byId("commands").replaceChildren(...COMMANDS.map(command => this.button(...command)));
    for (const [name, [least, most]] of Object.entries(limits)) Object.assign(byId(name), { min: least, max: most });
    for (const part of document.querySelectorAll("#settings .guided")) part.hidden = !("autoguidance" in limits);
    this.show({ settings, recording: false, goal: false, planning: false });
  }

  button(name, words, key, title) {
    const button = make("button", { type: "button", id: name, title });
    button.append(words);
    if (key in this.keys) button.append(make("kbd", { textContent: keyName(key) === "Escape" ? "Esc" : keyName(key) }));
    button.onclick = () => this.command(name);
    return button;
  }

  command(name) {
    if (byId(name).getAttribute("aria-disabled") === "true") return;
    this.tookGoal ||= name === "goal"; // its picture is shown when the server has it
    if (name === "record") setAble(byId(name), false); // until the server has begun, or saved
    this.send(name, name === "record" ? { on: !this.state.recording } : {});
  }

  pressed(event) {
    const name = this.keys?.[event.code];
    if (!name || event.repeat || event.ctrlKey || event.altKey || event.metaKey || inField(event)) return;
    this.command(name);
  }

  show(state) {
    this.state = state;
    setAble(byId("record"), true);
    byId("record").setAttribute("aria-pressed", String(state.recording));
    byId("record").firstChild.textContent = state.recording ? "End recording" : "Record";
    setAble(byId("plan"), state.goal && !state.planning);
    setAble(byId("stop"), state.planning);
    byId("goal-box").hidden = !state.goal;
    this.fill();
  }

  fill() {
    const { settings } = this.state;
    for (const name of FIELDS) {
      if (document.activeElement !== byId(name)) byId(name).value = settings[name];
      if (byId(`${name}-now`)) byId(`${name}-now`).textContent = settings[name];
    }
    byId("ahead").checked = settings.ahead;
  }

  able(connected) {
    for (const part of ["moves", "commands", "settings"]) byId(part).inert = !connected;
  }

  recorded({ frames, video, trajectory, folder }) {
    const item = make("li");
    item.append(`${frames} frames: `, link("video", video), ", ", link("trajectory", trajectory));
    if (folder) item.append(make("span", { className: "soft", textContent: ` also in ${folder}` }));
    byId("recording-list").prepend(item);
    byId("recordings").hidden = false;
  }

  // Say one line: notices go by themselves, errors stay until they are closed.
  say(text, kind, more = null) {
    const lines = byId("lines"), line = make("p", { className: kind });
    for (const same of [...lines.children].filter(old => old.firstChild.textContent === text)) same.remove();
    const close = make("button", { type: "button", textContent: "×", onclick: () => line.remove() });
    close.setAttribute("aria-label", "Close this line");
    line.append(make("span", { textContent: text }), ...(more ? [more] : []), close);
    lines.append(line);
    while (lines.children.length > MOST_LINES) lines.firstChild.remove();
    if (kind === "notice") setTimeout(() => line.remove(), NOTICE);
  }
}

// Says whether a button can be pressed; unlike one that is disabled, it keeps the focus.
function setAble(button, able) {
  button.setAttribute("aria-disabled", String(!able));
}

function link(words, address) {
  return make("a", { href: address, download: "", textContent: words });
}
