"""What is wrong with a picture, and how large one may be."""

from __future__ import annotations

MAX_PIXELS = 16_000_000  # a 389 kB PNG can otherwise claim gigabytes
MAX_SIDE_PX = 65_535  # JPEG knows no longer one; decoders keep 8 bytes for each row


class ImageError(ValueError):
    """A picture that cannot be used: states the rule, the value received and the remedy."""

    def __init__(self, rule: str, received: object, remedy: str):
        self.rule, self.received, self.remedy = rule, received, remedy
        super().__init__(f'{rule}; received {received!r}; {remedy}')


class ForeignFormatError(ImageError):
    """A whole picture perhaps, but in a format that is not read, such as HEIC."""


class TooLargeError(ImageError):
    """A picture of more pixels than memory is taken for."""


def check_size(height: int, width: int, most: int = MAX_PIXELS) -> None:
    """Refuse a picture without pixels, or with more than `most`.

    Raises:
        ImageError: it is such a picture.
    """
    if height < 1 or width < 1:
        raise ImageError('a picture has at least one pixel', (height, width),
                         'check the camera driver')
    if height * width > most or max(height, width) > MAX_SIDE_PX:
        raise TooLargeError(f'a picture has at most {most} pixels, {MAX_SIDE_PX} on a side',
                            (height, width), 'lower its resolution')


def truncated(rule: str, received: object) -> ImageError:
    """The error of a file that ends too early."""
    return ImageError(rule, received, 'the data is truncated: check the network and the camera '
                      'driver, or copy the file again')


def damaged(rule: str, received: object) -> ImageError:
    """The error of a file that is not what its format says."""
    return ImageError(rule, received,
                      'the data is damaged: check the camera driver, or copy the file again')
