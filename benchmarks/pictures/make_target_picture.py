"""Front and back of the printed target, side by side, as the README shows them.

python benchmarks/pictures/make_target_picture.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pypdfium2  # type: ignore[import-untyped]

from perchctl.profile import TargetConfig
from perchctl.target.page import PAGES_MM
from perchctl.target.pdf import pdf_bytes
from perchctl.target.sheets import target_pages

DPI = 75
GAP_PX, BACKGROUND, EDGE = 16, 255, 150


def main() -> None:
    pdf = pdf_bytes(target_pages(TargetConfig(), PAGES_MM["a4"], 0.05, "profile sim"), "target")
    document = pypdfium2.PdfDocument(pdf)
    sheets = []
    for page in document:
        # Drawn fine and shrunk: thin lines stay visible in a small picture.
        fine = page.render(scale=4 * DPI / 72.0, grayscale=True).to_numpy()
        picture = cv2.resize(
            fine.reshape(fine.shape[:2]), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA
        )
        sheets.append(np.pad(picture, 1, constant_values=EDGE))
    gap = np.full((sheets[0].shape[0], GAP_PX), BACKGROUND, np.uint8)
    both = np.hstack([sheets[0], gap, sheets[1]])
    path = Path(__file__).with_name("target.png")
    cv2.imwrite(str(path), both, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
