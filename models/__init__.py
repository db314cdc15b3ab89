"""From bytes to embedding: decoding, packs, detection, alignment, embedding.

Photos of strangers come in, unit vectors go out; nothing here knows of templates or of HTTP.
"""

import os

import cv2

# Before onnxruntime loads: its official builds report usage to their maker, and keep a device id
# and a database of events below the home folder. A service for faces does neither.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

# Requests run beside each other, and OpenCV's threads would wait for each other. And a process
# that has started them cannot be forked: in the child they are missing, and waited for.
cv2.setNumThreads(0)
