// The site's search runs in a Worker, which browsers refuse to a page opened from a folder: run it in a hidden frame there.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      // Messages that come before the script has loaded wait for it, in their order.
      this.ready = new Promise(shown => { this.frame.onload = shown }).then(() => this.start(url))
      document.documentElement.append(this.frame)
    }

    start(url) {
      const inside = this.frame.contentWindow
      const load = address => new Promise((loaded, failed) => {
        const script = inside.document.createElement("script")
        Object.assign(script, {src: address, onload: loaded, onerror: failed})
        inside.document.head.append(script)
      })
      inside.importScripts = (...addresses) => addresses.reduce((last, next) => last.then(() => load(next)), Promise.resolve())
      inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", {data}))
      return load(url)
    }

    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", {data})))
    }

    terminate() {
      this.frame.remove()
    }
  }
}
