"""What a file is that is no picture Veilface reads, told by its first bytes."""

import re

# Asked in this order. Why none of these pictures is read: docs/models.md.
_KINDS: tuple[tuple[str, bytes], ...] = (
    ("an AVIF picture", rb"....ftyp.{0,64}avi[fs]"),
    ("a HEIC picture", rb"....ftyp(hei|hev|mif1|msf1)"),
    ("a video", rb"....ftyp|\x1aE\xdf\xa3|RIFF....AVI "),
    ("a GIF picture", rb"GIF8[79]a"),
    ("a TIFF or raw picture", rb"II[*+]\0|MM\0[*+]"),
    ("a JPEG 2000 picture", rb"\0\0\0\x0cjP {2}|\xff\x4f\xff\x51"),
    ("a JPEG XL picture", rb"\xff\x0a|\0\0\0\x0cJXL "),
    ("a PDF document", rb"%PDF-"),
    ("a ZIP archive", rb"PK\x03\x04"),
    ("an SVG drawing", rb"\s*(<\?xml.{0,400})?<svg"),
    ("a web page", rb"\s*<(!doctype html|html)"),
    ("a picture in base64", rb"\s*(data:image/|/9j/|iVBORw0K|UklGR)"),
)
_REMEDIES = {
    "a picture in base64": "send the bytes that the text stands for",
    "a web page": "save the photo itself, not the page that shows it",
}


def unread_file(data: bytes) -> str:
    """Return the sentence that refuses a file, and names what it is where that is known."""
    head = data[:512]
    for kind, pattern in _KINDS:
        if re.match(pattern, head, re.DOTALL | re.IGNORECASE):
            remedy = _REMEDIES.get(kind, "save it as JPEG, and send that")
            return f"The file is {kind}, which is not read: {remedy}."
    return "The file is not a JPEG, PNG, WebP or BMP picture, or is damaged."
