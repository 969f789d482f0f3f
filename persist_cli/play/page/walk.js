// The page: what happens when a message comes, and the line that says how things are.

const PATIENCE = 350; // milliseconds without a frame after which the page says that the model is thinking

let connected = false, ever = false, standing = true, blocked = false, lastFrame = 0;
const views = new Views(), figures = new Figures();
const controls = new Controls((type, values) => connection.send(type, values));
const ground = new Ground((x, y) => connection.send("jump", { x, y }));
const held = new Held((actions, { pressed, first, at }) => {
  connection.send("keys", { held: actions });
  byId("hint").hidden = true;
  standing = !actions.length;
  if (pressed) blocked = false; // the next frame says whether this way is free
  lastFrame = performance.now();
  if (pressed && first && connected && !controls.state.planning) figures.press(pressed, at);
  tell();
});

const connection = new Connection({
  welcome(message) {
    if (message.protocol !== PROTOCOL) return controls.say("this page is older or newer than the server; reload it", "error");
    connected = ever = true;
    blocked = false;
    byId("model").textContent = message.model;
    document.title = `persist play: ${message.model}`;
    views.begin(message.memories, message.image);
    held.begin(message.actions, byId("moves"));
    controls.begin(message);
    ground.begin();
    figures.forget();
    byId("recording-list").replaceChildren(); // they went with the session before
    byId("recordings").hidden = true;
    hint(message.actions);
    tell();
  },
  frame(header, images) {
    views.draw(header, images);
    connection.send("ack", { number: header.number });
    figures.frame(header);
    ground.stand(header.pose);
    blocked = !header.free;
    lastFrame = performance.now();
    tell();
  },
  map: (header, images) => ground.draw(header, images),
  state(state) {
    if (state.goal && (controls.tookGoal || !controls.state.goal)) keepGoal();
    controls.tookGoal = false;
    controls.show(state);
    byId("stage").classList.toggle("recording", state.recording);
    tell();
  },
  notice: ({ text }) => controls.say(text, "notice"),
  error: ({ text, ended }) => controls.say(text, ended ? "error ended" : "error"),
  recorded: message => controls.recorded(message),
  lost(wait, taken) {
    gone();
    tell(`${taken ? "No free session" : "Connection lost"}; trying again in ${Math.ceil(wait / 1000)} s`);
  },
  ended() {
    gone();
    tell("The session has ended");
    const again = make("button", { type: "button", textContent: "begin a new one" });
    again.onclick = () => (again.parentElement.remove(), connection.open());
    controls.say("This session has ended.", "error", again);
  },
  fault: error => controls.say(`this page failed: ${error.message}; reload it`, "error"),
});

function gone() {
  connected = false;
  held.releaseAll();
  byId("stage").classList.remove("recording", "blocked"); // the walk and its recording have ended
}

// What is seen now is the goal; the server takes it at the same moment, when nothing is on the way.
function keepGoal() {
  const picture = byId("goal-picture"), shown = views.canvases[0];
  Object.assign(picture, { width: shown.width, height: shown.height });
  picture.getContext("2d").drawImage(shown, 0, 0);
  picture.style.width = "8rem";
}

function hint(actions) {
  const keys = actions.filter(({ name }) => MOVES.includes(name)).map(({ keys: [key] }) => key && keyName(key)).filter(Boolean);
  byId("hint").textContent = matchMedia("(pointer: coarse)").matches ? "Hold a button to walk" : `Hold ${keys.join(" ")} or the arrow keys to walk`;
  byId("hint").hidden = false;
}

function tell(trouble) {
  const late = performance.now() - lastFrame > PATIENCE;
  const walking = controls.state.planning || !standing;
  let kind = "ready", words = "Ready";
  if (!connected) [kind, words] = [ever ? "lost" : "wait", trouble ?? byId("state").textContent];
  else if (walking && blocked) [kind, words] = ["blocked", "Blocked: something is in the way"];
  else if (walking && late) [kind, words] = ["busy", "Thinking …"];
  else if (controls.state.planning) [kind, words] = ["busy", "Walking to the goal"];
  else if (walking) [kind, words] = ["busy", "Walking"];
  const state = byId("state");
  if (state.textContent !== words) state.textContent = words;
  if (kind !== "busy" && byId("news").textContent !== words) byId("news").textContent = words; // screen readers say this
  state.dataset.kind = kind;
  byId("stage").classList.toggle("lost", ever && !connected);
  controls.able(connected);
}

tell("Connecting …");
setInterval(() => connected && tell(), 500);
