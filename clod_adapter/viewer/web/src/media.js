// Pictures and videos of the canvas, as downloads.

const TYPES = ["video/mp4;codecs=avc1.640028", "video/webm;codecs=vp9", "video/webm"];
const FPS = 30, BITS = 16e6; // per second

export function download(blob, name) {
  const link = document.createElement("a"), url = URL.createObjectURL(blob);
  Object.assign(link, { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

const videoType = () => (window.MediaRecorder && HTMLCanvasElement.prototype.captureStream ? TYPES.find((type) => MediaRecorder.isTypeSupported(type)) : undefined);

export const canRecord = () => videoType() !== undefined;

/** Records the canvas until `stop()`, which resolves with {blob, suffix}. */
export function record(canvas) {
  const stream = canvas.captureStream(FPS), recorder = new MediaRecorder(stream, { mimeType: videoType(), videoBitsPerSecond: BITS }), parts = [];
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.start();
  return {
    stop: () => new Promise((resolve) => {
      recorder.onstop = () => {
        for (const track of stream.getTracks()) track.stop();
        resolve({ blob: new Blob(parts, { type: recorder.mimeType }), suffix: recorder.mimeType.includes("mp4") ? "mp4" : "webm" });
      };
      recorder.stop();
    }),
  };
}
