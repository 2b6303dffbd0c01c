// Search without a server: browsers start no worker from a file on disk, so the worker's script runs in a hidden frame.
// The site's search asks for the URL it would give to `new Worker(url)` and exchanges messages; nothing else is needed.
(function () {
  "use strict";
  if (window.location.protocol !== "file:") return;

  class IFrameWorker extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      const inside = frame.contentWindow;
      const page = frame.contentDocument;

      // What the script says goes to whoever listens to this object; the frame's own `postMessage` is set aside.
      inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      inside.importScripts = (...urls) =>
        urls.reduce((before, next) => before.then(() => load(page, next)), Promise.resolve());

      const queue = [];
      let deliver = (data) => queue.push(data);
      this.postMessage = (data) => deliver(data);
      load(page, url).then(() => {
        deliver = (data) => inside.dispatchEvent(new MessageEvent("message", { data }));
        queue.forEach(deliver);
      });
      this.terminate = () => frame.remove();
    }
  }

  function load(page, url) {
    return new Promise((done, failed) => {
      const script = page.createElement("script");
      script.src = url;
      script.onload = done;
      script.onerror = failed;
      page.head.appendChild(script);
    });
  }

  window.IFrameWorker = IFrameWorker;
  window.Worker = IFrameWorker;
})();
