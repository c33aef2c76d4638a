/* A camera that circles a target: azimuth and elevation in degrees as on the turntable (0 towards +z, growing towards +x), distance in mm. */
class Orbit {
  constructor(canvas, changed) {
    Object.assign(this, { canvas, changed, azimuth: 0, elevation: 8, distance: 1, target: [0, 0, 0], home: null, flight: 0 });
    this.fingers = new Map();
    canvas.addEventListener("pointerdown", (e) => this.down(e));
    canvas.addEventListener("pointermove", (e) => this.move(e));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => this.fingers.delete(e.pointerId));
    canvas.addEventListener("wheel", (e) => this.wheel(e), { passive: false });
    canvas.addEventListener("keydown", (e) => this.key(e));
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  }

  /** Unit vectors: towards the camera, to its right, up in its picture. */
  axes() {
    const a = (this.azimuth * Math.PI) / 180, e = (this.elevation * Math.PI) / 180;
    const out = [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)], right = [Math.cos(a), 0, -Math.sin(a)];
    return { out, right, up: [-Math.sin(a) * Math.sin(e), Math.cos(e), -Math.cos(a) * Math.sin(e)] };
  }

  eye() { const { out } = this.axes(); return this.target.map((x, k) => x + this.distance * out[k]); }

  turn(da, de) { this.halt(); this.azimuth = (((this.azimuth + da) % 360) + 360) % 360; this.elevation = Math.max(-89, Math.min(89, this.elevation + de)); this.changed(); }

  zoom(factor) { this.halt(); this.distance = Math.max(this.home.distance / 60, Math.min(this.home.distance * 3, this.distance * factor)); this.changed(); }

  /** Shift the target by shares of the picture's height. */
  shift(dx, dy) {
    this.halt();
    const { right, up } = this.axes(), scale = this.distance * this.home.spread;
    this.target = this.target.map((x, k) => x + scale * (dy * up[k] - dx * right[k]));
    this.changed();
  }

  halt() { cancelAnimationFrame(this.flight); this.flight = 0; }

  /** Go to another pose, the short way round. */
  fly(pose) {
    this.halt();
    const from = { azimuth: this.azimuth, elevation: this.elevation, distance: this.distance, target: [...this.target] };
    const da = ((pose.azimuth - from.azimuth + 540) % 360) - 180, start = performance.now(), takes = calm.matches ? 0 : 450;
    const step = (now) => {
      const t = takes ? Math.min(1, (now - start) / takes) : 1, s = t * t * (3 - 2 * t);
      this.azimuth = (from.azimuth + s * da + 360) % 360;
      this.elevation = from.elevation + s * (pose.elevation - from.elevation);
      this.distance = from.distance * (pose.distance / from.distance) ** s;
      this.target = from.target.map((x, k) => x + s * (pose.target[k] - x));
      this.flight = t < 1 ? requestAnimationFrame(step) : 0;
      this.changed();
    };
    step(start);
  }

  down(e) { this.canvas.setPointerCapture(e.pointerId); this.fingers.set(e.pointerId, [e.clientX, e.clientY]); }

  move(e) {
    const before = this.fingers.get(e.pointerId);
    if (!before) return;
    const dx = e.clientX - before[0], dy = e.clientY - before[1], size = this.canvas.clientHeight;
    const others = [...this.fingers].filter(([id]) => id !== e.pointerId).map(([, at]) => at);
    if (others.length) {
      const [ox, oy] = others[0];
      this.zoom(Math.hypot(before[0] - ox, before[1] - oy) / Math.max(1, Math.hypot(e.clientX - ox, e.clientY - oy)));
      this.shift(dx / size / 2, dy / size / 2);
    } else if (e.buttons & 2 || e.shiftKey) this.shift(dx / size, dy / size);
    else this.turn((-dx / size) * 180, (dy / size) * 120);
    this.fingers.set(e.pointerId, [e.clientX, e.clientY]);
  }

  wheel(e) {
    if (document.activeElement !== this.canvas && !e.ctrlKey) return;
    e.preventDefault();
    this.zoom(Math.exp(Math.max(-0.4, Math.min(0.4, e.deltaY * (e.deltaMode ? 0.05 : 0.0015)))));
  }

  key(e) {
    if (e.ctrlKey || e.altKey || e.metaKey) return;
    const arrow = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    if (arrow) { if (e.shiftKey) this.shift(arrow[0] * 0.08, -arrow[1] * 0.08); else this.turn(-arrow[0] * 10, arrow[1] * 10); }
    else if (e.key === "+" || e.key === "=") this.zoom(1 / 1.2);
    else if (e.key === "-" || e.key === "_") this.zoom(1.2);
    else if (e.key === "Home") this.fly(this.home);
    else return;
    e.preventDefault();
  }
}
