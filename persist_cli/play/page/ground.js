// The map from above: the agent on it, and places to jump to, by mouse, finger or keyboard.

const STRIDE = 0.04; // of the map, that an arrow key moves the cross
const ASIDE = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

class Ground {
  constructor(jump) {
    this.canvas = byId("map");
    this.jump = jump;
    this.canvas.onclick = event => {
      this.canvas.blur(); // the arrow keys walk again
      const box = this.canvas.getBoundingClientRect();
      this.choose((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    };
    this.canvas.onkeydown = event => this.pressed(event);
    this.canvas.onblur = () => (byId("cross").hidden = true);
  }

  begin() {
    this.extent = this.cross = null;
    byId("agent").hidden = byId("cross").hidden = true;
  }

  draw({ extent }, [image]) {
    this.extent = extent;
    const most = Math.min(336, 0.6 * innerHeight), scale = Math.min(most / image.width, most / image.height);
    this.canvas.style.width = `${Math.round(scale * image.width)}px`;
    drawImage(this.canvas, image);
    if (this.pose) this.stand(this.pose);
  }

  stand(pose) {
    this.pose = pose;
    if (!this.extent) return;
    const [x0, y0, x1, y1] = this.extent, agent = byId("agent");
    put(agent, (pose.x - x0) / (x1 - x0), (y1 - pose.y) / (y1 - y0));
    agent.style.rotate = `${90 - pose.degrees}deg`; // it is drawn looking up, and 0° looks along x
  }

  // Jump to a place in shares of the map's width and height, from its top left.
  choose(across, down) {
    if (!this.extent) return;
    const [x0, y0, x1, y1] = this.extent;
    this.cross = [across, down];
    this.jump(x0 + across * (x1 - x0), y1 - down * (y1 - y0));
  }

  pressed(event) {
    if (!this.extent) return;
    this.cross ??= [0.5, 0.5];
    if (event.code === "Enter") this.choose(...this.cross);
    else if (ASIDE[event.code]) this.cross = this.cross.map((at, axis) => Math.min(1, Math.max(0, at + STRIDE * ASIDE[event.code][axis])));
    else return;
    event.preventDefault();
    put(byId("cross"), ...this.cross);
  }
}

function put(element, across, down) {
  element.hidden = false;
  element.style.left = `${100 * across}%`;
  element.style.top = `${100 * down}%`;
}
