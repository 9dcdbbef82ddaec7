// The frames that a view over time shows, between two margins in pixels: zoom and pan by wheel and drag.

const MIN_FRAMES = 10;
const WHEEL_FACTOR = 1.25;
const PAN_SHARE = 0.1;

export class TimeWindow {
  // `onChange` is called after every change of the frames and of the size of the view, which is that of `box`.
  constructor(element, { left, right, onChange, accepts = () => true, box = element }) {
    Object.assign(this, { element, left, right, onChange, first: 0, last: 1, count: 2, pan: null, width: 1 });
    new ResizeObserver(() => {
      this.width = Math.max(1, box.clientWidth - left - right);  // reading it for each picture would lay out the page
      onChange();
    }).observe(box);
    element.addEventListener("wheel", (event) => {
      if (!accepts(event)) return;
      event.preventDefault();
      const steps = Math.sign(event.deltaY || event.deltaX), isPan = event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY);
      if (isPan) this.move(steps * PAN_SHARE * (this.last - this.first));
      else this.zoom(steps > 0 ? WHEEL_FACTOR : 1 / WHEEL_FACTOR, this.frameAt(event.clientX));
    }, { passive: false });
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 1 && !event.altKey) return;
      event.preventDefault();
      element.setPointerCapture(event.pointerId);
      this.pan = event.clientX;
    });
    element.addEventListener("pointermove", (event) => {
      if (this.pan === null) return;
      this.move(((this.pan - event.clientX) * (this.last - this.first)) / this.width);
      this.pan = event.clientX;
    });
    for (const name of ["pointerup", "pointercancel"]) element.addEventListener(name, () => { this.pan = null; });
  }

  get isWhole() { return this.first <= 0 && this.last >= this.count - 1; }

  setCount(count) {
    this.count = count;
    this.show(0, count - 1);
  }

  // Shows the frames first..last, at least a few, within the take.
  show(first, last) {
    const length = Math.min(this.count - 1, Math.max(last - first, Math.min(MIN_FRAMES, this.count - 1)));
    this.first = Math.min(Math.max(0, first), this.count - 1 - length);
    this.last = Math.max(this.first + length, 1);
    this.onChange();
  }

  zoom(factor, frame) { this.show(frame - (frame - this.first) * factor, frame + (this.last - frame) * factor); }

  move(frames) { this.show(this.first + frames, this.last + frames); }

  // Moves the frames so that one is among them.
  reveal(frame) {
    if (frame < this.first || frame > this.last) this.move(frame - (this.first + this.last) / 2);
  }

  x(frame) { return this.left + ((frame - this.first) / (this.last - this.first)) * this.width; }

  // Frame at a place in the page, within the take.
  frameAt(clientX) {
    const share = (clientX - this.element.getBoundingClientRect().left - this.left) / this.width;
    return Math.min(Math.max(Math.round(this.first + share * (this.last - this.first)), 0), this.count - 1);
  }
}
