// The WebSocket to the server: JSON both ways, pictures as binary messages. A lost connection comes back by itself.

const PROTOCOL = 1;
const FIRST_WAIT = 400, LONGEST_WAIT = 5000; // milliseconds between two attempts
const TAKEN = 1013; // all sessions are taken
const REFUSED = new Set([1008, 1009]); // the page did what it must not do
const FAULT = 1011; // of this session, if the server has said so; else it only had no answer for long, as from a laptop asleep

class Connection {
  // `on` has a function for each type of message, and `open`, `lost(wait, taken)` and `ended`.
  constructor(on) {
    this.on = on;
    this.wait = FIRST_WAIT;
    this.turn = Promise.resolve(); // messages are handled one after the other, though pictures are decoded aside
    this.open();
  }

  open() {
    clearTimeout(this.later);
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/walk`);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      this.turn = this.turn.then(() => this.socket === socket && this.read(data)).catch(error => this.on.fault(error));
    };
    socket.onclose = ({ code }) => this.socket === socket && this.turn.then(() => this.closed(code));
    this.socket = socket;
    this.failed = false;
  }

  async read(data) {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "welcome") this.wait = FIRST_WAIT;
      if (message.ended) this.failed = true;
      this.on[message.type]?.(message);
    } else {
      const { header, images } = await unpack(data);
      this.on[header.type]?.(header, images);
    }
  }

  closed(code) {
    if (REFUSED.has(code) || (code === FAULT && this.failed)) return this.on.ended();
    this.on.lost(this.wait, code === TAKEN);
    this.later = setTimeout(() => this.open(), this.wait);
    this.wait = Math.min(2 * this.wait, LONGEST_WAIT);
  }

  send(type, values = {}) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type, ...values }));
  }
}

// A binary message: the length of the header, the header, and the images one after another, here as bitmaps.
async function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let place = 4 + length;
  const blobs = header.images.map(({ bytes }) => {
    const blob = new Blob([new Uint8Array(buffer, place, bytes)], { type: "image/png" });
    place += bytes;
    return blob;
  });
  return { header, images: await Promise.all(blobs.map(blob => createImageBitmap(blob))) };
}
