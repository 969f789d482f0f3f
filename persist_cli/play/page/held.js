// Which actions are held: by keys, by fingers on buttons, by Space on a button. Several of them may hold one action.

const MOVES = ["forward", "left", "backward", "right"]; // they stand as a cross
const ARROWS = { forward: "↑", left: "←", backward: "↓", right: "→" };

const layout = (await navigator.keyboard?.getLayoutMap().catch(() => null)) ?? new Map(); // letter by KeyboardEvent.code

class Held {
  constructor(changed) {
    this.sources = new Map(); // action by what holds it
    this.changed = changed;
    this.keys = {}; // action by KeyboardEvent.code
    addEventListener("keydown", event => this.pressed(event));
    // On a Mac no keyup comes of the keys that are let go while Meta is down.
    addEventListener("keyup", event => (event.key === "Meta" ? this.releaseAll() : this.release(event.code)));
    addEventListener("blur", () => this.releaseAll());
    document.addEventListener("visibilitychange", () => document.hidden && this.releaseAll());
  }

  get actions() {
    return [...new Set(this.sources.values())];
  }

  begin(actions, place) {
    this.releaseAll(); // what was pressed before, this session may have heard already
    this.keys = Object.fromEntries(actions.flatMap(({ name, keys }) => keys.map(key => [key, name])));
    const buttons = Object.fromEntries(actions.map(action => [action.name, this.button(action)]));
    const cross = make("div", { className: "cross" }), others = make("div", { className: "others" });
    for (const [name, button] of Object.entries(buttons)) (MOVES.includes(name) ? cross : others).append(button);
    place.replaceChildren(...[cross, others].filter(group => group.children.length));
    this.buttons = buttons;
  }

  button({ name, effect, keys }) {
    const words = name.replaceAll("_", " ");
    const button = make("button", { type: "button", title: `${words}: ${effect}` });
    button.setAttribute("aria-pressed", "false");
    button.dataset.action = name;
    if (ARROWS[name]) {
      button.style.gridArea = name;
      button.setAttribute("aria-label", words);
      button.append(make("span", { className: "arrow", textContent: ARROWS[name] }));
    } else button.append(words);
    const key = keys.find(code => !code.startsWith("Arrow"));
    if (key) button.append(make("kbd", { textContent: keyName(key) }));
    let used = false; // by a pointer or a key, after which a click comes too
    button.onpointerdown = event => {
      if (event.button !== 0) return;
      used = true;
      button.setPointerCapture(event.pointerId); // a finger that slides off still releases this button
      this.hold(event.pointerId, name, event);
    };
    button.onpointerup = button.onpointercancel = button.onlostpointercapture = event => this.release(event.pointerId);
    button.oncontextmenu = event => event.preventDefault(); // a long touch
    button.onkeydown = event => {
      if (event.code !== "Space" && event.code !== "Enter") return;
      used = true;
      if (!event.repeat) this.hold(event.code, name, event);
    };
    button.onclick = event => {
      if (!used) this.tap(name, event); // assistive technology clicks without either
      used = false;
    };
    button.onblur = () => ["Space", "Enter"].forEach(code => this.release(code));
    return button;
  }

  pressed(event) {
    const action = this.keys[event.code];
    if (!action || event.defaultPrevented || event.ctrlKey || event.altKey || event.metaKey || inField(event)) return;
    if (event.code === "Space" && event.target.closest?.("button")) return; // it presses that button
    event.preventDefault(); // arrow keys would scroll
    if (!event.repeat) this.hold(event.code, action, event);
  }

  hold(source, action, event) {
    const before = this.actions;
    this.sources.set(source, action);
    if (!before.includes(action)) this.tell({ pressed: action, first: !before.length, at: event.timeStamp });
  }

  release(source) {
    const action = this.sources.get(source);
    if (this.sources.delete(source) && !this.actions.includes(action)) this.tell({});
  }

  tap(action, event) {
    this.hold("click", action, event);
    this.release("click");
  }

  releaseAll() {
    if (!this.sources.size) return;
    this.sources.clear();
    this.tell({});
  }

  tell(what) {
    for (const [name, button] of Object.entries(this.buttons ?? {}))
      button.setAttribute("aria-pressed", String(this.actions.includes(name)));
    this.changed(this.actions, what);
  }
}

// Whether a key belongs to the field or the map that has the focus: letters mean nothing to a slider.
function inField({ target, code }) {
  if (target.matches?.("input[type=checkbox]")) return code === "Space";
  if (target.matches?.("#map, input[type=range]")) return !/^(Key.|Escape)$/.test(code);
  return Boolean(target.matches?.("input, textarea, select"));
}

// What stands on the key at a place, "Z" at KeyW on a French keyboard; where the browser does not tell, as on an American one.
function keyName(code) {
  return layout.get(code)?.toUpperCase() ?? code.replace(/^(Key|Digit)/, "");
}

function make(tag, properties = {}) {
  return Object.assign(document.createElement(tag), properties);
}
