"""From bytes to embedding: decoding, packs, detection, alignment, embedding.

Photos of strangers come in, unit vectors go out; nothing here knows of templates or of HTTP.
"""

import os

# Before onnxruntime loads: its official builds report usage to their maker, and keep a device id
# and a database of events below the home folder. A service for faces does neither.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
