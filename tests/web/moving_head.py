"""A camera in the browser that shows marked heads: one that does what the page asks, or another."""

import base64
import json

from tests.heads import POSES
from tests.marked_heads import draw, encoded, head

_SCRIPT = """
(() => {
  const heads = %s;
  const shown = (asked) => (%s)(asked);
  const bitmaps = {};
  for (const [name, text] of Object.entries(heads)) {
    const bytes = Uint8Array.from(atob(text), (each) => each.charCodeAt(0));
    bitmaps[name] = createImageBitmap(new Blob([bytes], { type: "image/png" }));
  }
  window.shownPoses = [];
  navigator.mediaDevices.getUserMedia = async () => {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 640;
    const context = canvas.getContext("2d");
    const ready = Object.fromEntries(
      await Promise.all(Object.entries(bitmaps).map(async ([name, each]) => [name, await each])),
    );
    const drawOne = () => {
      const asked = %s;
      const pose = shown(asked in ready ? asked : "front");
      if (window.shownPoses.at(-1) !== pose) window.shownPoses.push(pose);
      context.drawImage(ready[pose], 0, 0);
    };
    drawOne();
    const timer = setInterval(drawOne, 40);
    const stream = canvas.captureStream(25);
    const [track] = stream.getVideoTracks();
    const stop = track.stop.bind(track);
    track.stop = () => { clearInterval(timer); stop(); };
    window.cameraTrack = track;
    return stream;
  };
})();
"""


ON_THE_PAGE = 'document.querySelector(".movement")?.dataset.movement'


def camera_script(
    shown: str = "(asked) => asked", *, person: int = 1, asked: str = ON_THE_PAGE
) -> str:
    """A script for a page: its camera shows what `shown` makes of the movement that is `asked`.

    What is no pose, as moving back is none, is to look straight ahead.
    """
    heads = {
        name: base64.b64encode(encoded(draw(head(**pose), person))).decode("ascii")
        for name, pose in POSES.items()
    }
    return _SCRIPT % (json.dumps(heads), shown, asked)
