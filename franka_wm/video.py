"""Frames into files: video, animated image, still. Frames are uint8 RGB, as the camera gives them."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from franka_wm.errors import UserError
from franka_wm.files import atomic_write


def write_video(frames: Tensor, path: str | Path, fps: int) -> Path:
    """Write an .mp4 that browsers and editors play: H.264, yuv420p.

    Args:
        frames: (T, H, W, 3) uint8, T ≥ 1; H and W even, since the format halves the colour's resolution.
        path: ends in .mp4; its folder is made.
        fps: frames per second.

    Returns:
        `path`.

    Raises:
        UserError: other frames, another ending, fps below 1, or the file cannot be written.
    """
    path = Path(path)
    _check_frames(frames, path, ".mp4", fps)
    height, width = frames.shape[1:3]
    if height % 2 or width % 2:
        raise UserError(
            f"cannot write {path.name}: frames are {height} × {width}, H.264 needs an even height and width; "
            "render or pad to even sizes."
        )
    import av

    with (
        atomic_write(path) as temporary,
        av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as container,
    ):
        stream = container.add_stream("libx264", rate=fps, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in frames:  # one at a time: a long video need not fit into host memory twice
            image = av.VideoFrame.from_ndarray(frame.contiguous().cpu().numpy(), format="rgb24")
            container.mux(stream.encode(image))
        container.mux(stream.encode())
    return path


def write_gif(frames: Tensor, path: str | Path, fps: int) -> Path:
    """Write an endless animated .gif; `frames`, `path`, `fps` and errors as for `write_video`, any sizes.

    A .gif counts in hundredths of a second, so `fps` is met only roughly above 30, and at most 50.
    """
    path = Path(path)
    _check_frames(frames, path, ".gif", fps)
    from PIL import Image

    first, *rest = [Image.fromarray(frame.contiguous().cpu().numpy()) for frame in frames]
    duration_ms = max(20, 10 * round(100 / fps))
    with atomic_write(path) as temporary:
        first.save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=rest,
            duration=duration_ms,
            loop=0,
            optimize=True,
        )
    return path


def write_png(frame: Tensor, path: str | Path) -> Path:
    """Write one image.

    Args:
        frame: (H, W, 3) uint8.
        path: ends in .png; its folder is made.

    Returns:
        `path`.

    Raises:
        UserError: another shape or dtype, another ending, or the file cannot be written.
    """
    path = Path(path)
    _check_frames(frame[None], path, ".png", 1)
    from PIL import Image

    with atomic_write(path) as temporary:
        Image.fromarray(frame.contiguous().cpu().numpy()).save(temporary, format="PNG", optimize=True)
    return path


def tile_frames(frames: Tensor, columns: int | None = None) -> Tensor:
    """Lay N worlds side by side, row by row.

    Args:
        frames: (T, N, H, W, 3), any dtype.
        columns: worlds per row; as square as possible if None.

    Returns:
        (T, rows·H, columns·W, 3); missing places in the last row are zero (black).

    Raises:
        UserError: another shape, or fewer than one column.
    """
    if frames.ndim != 5 or frames.shape[-1] != 3 or frames.shape[1] == 0:
        raise UserError(f"frames have shape {tuple(frames.shape)}; (T, N, H, W, 3) with N ≥ 1 is needed.")
    t, n, h, w, _ = frames.shape
    columns = math.ceil(math.sqrt(n)) if columns is None else columns
    if columns < 1:
        raise UserError(f"columns is {columns}; at least 1 is needed.")
    columns = min(columns, n)
    rows = math.ceil(n / columns)
    grid = frames.new_zeros((t, rows * columns, h, w, 3))
    grid[:, :n] = frames
    return grid.view(t, rows, columns, h, w, 3).transpose(2, 3).reshape(t, rows * h, columns * w, 3)


def draw_labels(frames: Tensor, texts: Sequence[str]) -> Tensor:
    """Write one line on a dark band at the top of every world's images; lines shrink until the longest fits.

    Args:
        frames: (T, N, H, W, 3) uint8.
        texts: N lines.

    Returns:
        New frames of the same shape.
    """
    from PIL import Image, ImageDraw, ImageFont

    labelled = frames.clone()
    height, width = frames.shape[2:4]
    size = max(8.0, height / 14)
    while size > 4 and max(map(ImageFont.load_default(size).getlength, texts)) > width - 6:
        size -= 0.5
    font, band = ImageFont.load_default(size), min(height, round(1.6 * size))
    for world, text in enumerate(texts):
        strip = Image.new("RGB", (width, band), (31, 35, 40))
        ImageDraw.Draw(strip).text((3, band / 2), text, font=font, anchor="lm", fill=(255, 255, 255))
        pixels = torch.frombuffer(bytearray(strip.tobytes()), dtype=torch.uint8)
        labelled[:, world, :band] = pixels.view(band, width, 3).to(frames.device)
    return labelled


def draw_marker(
    frames: Tensor, centres: Tensor, *, radius: float, colour: tuple[int, int, int] = (230, 75, 40)
) -> Tensor:
    """Draw a ring around one point of every image.

    Args:
        frames: (N, H, W, 3) uint8.
        centres: (N, 2) column and row [px]; may lie outside.
        radius: of the ring [px]; it is a quarter as thick.
        colour: RGB.

    Returns:
        New frames of the same shape, the ring's edge blended.
    """
    height, width = frames.shape[1:3]
    rows = torch.arange(height, device=frames.device).view(1, -1, 1) + 0.5
    columns = torch.arange(width, device=frames.device).view(1, 1, -1) + 0.5
    centres = centres.to(frames.device)
    distance = ((columns - centres[:, 0, None, None]) ** 2 + (rows - centres[:, 1, None, None]) ** 2).sqrt()
    cover = (radius / 8 + 0.5 - (distance - radius).abs()).clamp(0, 1).unsqueeze(-1)
    ink = torch.tensor(colour, device=frames.device)
    return (frames * (1 - cover) + ink * cover).round().to(torch.uint8)


def _check_frames(frames: Tensor, path: Path, ending: str, fps: int) -> None:
    if path.suffix.lower() != ending:
        raise UserError(f"cannot write {path.name}: the file must end in {ending}.")
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != torch.uint8 or 0 in frames.shape:
        raise UserError(
            f"cannot write {path.name}: frames are {tuple(frames.shape)} {frames.dtype}; "
            "RGB images (height, width, 3) of uint8 are needed, at least one."
        )
    if fps < 1:
        raise UserError(f"cannot write {path.name}: fps is {fps}; at least 1 is needed.")
