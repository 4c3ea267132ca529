// Search without a server: browsers refuse workers on pages that are opened from disk, so that the search script runs in
// a hidden frame instead, which answers to the same calls.
if (location.protocol === "file:") {
  window.IFrameWorker = class IFrameWorker extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      this.frame = frame;
      const inner = frame.contentDocument;
      inner.open();
      inner.write("<!doctype html><html><head></head><body></body></html>");
      inner.close();
      const window_ = frame.contentWindow;
      window_.postMessage_ = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      window_.importScripts = (...urls) =>
        urls.reduce((before, each) => before.then(() => load(inner, new URL(each, url).href)), Promise.resolve());
      // Within the frame, a message without a target goes to the page.
      const deliver = window_.postMessage.bind(window_);
      this.deliver = (data) => window_.dispatchEvent(new window_.MessageEvent("message", { data }));
      window_.postMessage = (data, target) => (target === undefined ? window_.postMessage_(data) : deliver(data, target));
      this.ready = load(inner, new URL(url, location).href);
    }
    postMessage(data) {
      this.ready.then(() => this.deliver(data));
    }
    set onmessage(listener) {
      this.addEventListener("message", listener);
    }
    terminate() {
      this.frame.remove();
    }
  };
  window.Worker = window.IFrameWorker;
}

function load(page, address) {
  return new Promise((done, failed) => {
    const script = page.createElement("script");
    script.src = address;
    script.onload = () => done();
    script.onerror = () => failed(new Error(address));
    page.body.append(script);
  });
}
