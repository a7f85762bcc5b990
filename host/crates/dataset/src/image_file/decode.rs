//! Decoding of image bytes; see the parent module for what is promised.

use std::io::{self, Cursor};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use image::{DynamicImage, ImageFormat};
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

use super::{GreyImage, ImageFileError, MAX_PIXELS, ReadNote};

/// No supported compression packs more pixels than this into one byte of the file; a header that
/// claims more belongs to a file that ends too early.
const MAX_PIXELS_PER_BYTE: u64 = 4096;

pub(super) fn decode(bytes: &[u8], path: &Path) -> Decoded {
    let source = Source { bytes, path };
    // The decoders are other people's code and the bytes may be anything: a bug there must reach
    // the user as a damaged file, not as a crash.
    let decoded = catch_unwind(AssertUnwindSafe(|| match bytes {
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => source.tiff(),
        [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, ..] => source.png(),
        [b'B', b'M', ..] => source.raster(ImageFormat::Bmp),
        _ => Err(source.unknown()),
    }));
    decoded.unwrap_or_else(|_| Err(source.damaged("the decoder failed on its content")))
}

struct Source<'a> {
    bytes: &'a [u8],
    path: &'a Path,
}

type Decoded = Result<(GreyImage, Vec<ReadNote>), ImageFileError>;

impl Source<'_> {
    fn damaged(&self, reason: impl ToString) -> ImageFileError {
        ImageFileError::Damaged { path: self.path.to_path_buf(), reason: reason.to_string() }
    }

    fn truncated(&self, reason: impl ToString) -> ImageFileError {
        ImageFileError::Truncated {
            path: self.path.to_path_buf(),
            bytes: self.bytes.len() as u64,
            reason: reason.to_string(),
        }
    }

    fn unsupported(&self, kind: impl ToString) -> ImageFileError {
        ImageFileError::Unsupported { path: self.path.to_path_buf(), kind: kind.to_string() }
    }

    /// Names formats that people do hand in, so that the error says what to do.
    fn unknown(&self) -> ImageFileError {
        const HEADS: [&[u8]; 3] = [b"II\x2a\x00", b"MM\x00\x2a", b"\x89PNG\x0d\x0a\x1a\x0a"];
        if HEADS.iter().any(|head| head.starts_with(self.bytes)) {
            return self.truncated("not even its signature is complete");
        }
        match self.bytes {
            [0xff, 0xd8, 0xff, ..] => self.unsupported("a JPEG (lossy: it alters the speckle)"),
            [b'G', b'I', b'F', b'8', ..] => self.unsupported("a GIF"),
            [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => self.unsupported("a WebP"),
            [b'P', b'1'..=b'7', b' ' | b'\n' | b'\r' | b'\t', ..] => self.unsupported("a PNM"),
            _ => ImageFileError::NotAnImage { path: self.path.to_path_buf() },
        }
    }

    fn check_size(&self, width: u32, height: u32) -> Result<(), ImageFileError> {
        let pixels = u64::from(width) * u64::from(height);
        if pixels == 0 {
            return Err(self.damaged(format!("its size is {width} x {height} pixels")));
        }
        if pixels > MAX_PIXELS {
            return Err(ImageFileError::TooLarge { path: self.path.to_path_buf(), width, height });
        }
        if pixels / MAX_PIXELS_PER_BYTE > self.bytes.len() as u64 {
            return Err(self.truncated(format!("its header promises {width} x {height} pixels")));
        }
        Ok(())
    }

    fn tiff_error(&self, error: TiffError) -> ImageFileError {
        match error {
            TiffError::IoError(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
                self.truncated("the decoder ran out of data")
            }
            TiffError::UnsupportedError(e) => self.unsupported(format!("a TIFF with {e}")),
            other => self.damaged(other),
        }
    }

    fn tiff(&self) -> Decoded {
        let Some((indexed, palette)) = self.indexed_tiff()? else {
            return self.plain_tiff();
        };
        let (index, mut notes) = Source { bytes: &indexed, path: self.path }.plain_tiff()?;
        let rgb = |&i: &u16| palette[usize::from(i.min(255))];
        let samples = index.data.iter().flat_map(rgb).collect();
        let (image, more) = self.grey(index.width, index.height, 8, 3, samples)?;
        notes.extend(more);
        Ok((image, notes))
    }

    /// For a TIFF of 8-bit indices into a palette, which the decoder refuses: the same file with
    /// its indices declared as grey values, and the palette as 8-bit red, green and blue.
    #[allow(clippy::type_complexity)]
    fn indexed_tiff(&self) -> Result<Option<(Vec<u8>, Vec<[u16; 3]>)>, ImageFileError> {
        const PALETTE: u16 = 3;
        let Some(at) = photometric_offset(self.bytes) else { return Ok(None) };
        let little = self.bytes[0] == b'I';
        let read = if little { u16::from_le_bytes } else { u16::from_be_bytes };
        if read([self.bytes[at], self.bytes[at + 1]]) != PALETTE {
            return Ok(None);
        }
        let mut indexed = self.bytes.to_vec();
        let grey: u16 = 1;
        let grey = if little { grey.to_le_bytes() } else { grey.to_be_bytes() };
        indexed[at..at + 2].copy_from_slice(&grey);
        let mut decoder = Decoder::new(Cursor::new(&indexed)).map_err(|e| self.tiff_error(e))?;
        match decoder.colortype().map_err(|e| self.tiff_error(e))? {
            ColorType::Gray(8) => {}
            _ => return Err(self.unsupported("a TIFF with a palette of other than 256 colours")),
        }
        let map = decoder.get_tag_u16_vec(Tag::ColorMap).map_err(|e| self.tiff_error(e))?;
        if map.len() != 3 * 256 {
            return Err(self.damaged(format!("its palette has {} of 768 entries", map.len())));
        }
        // Entries have 16 bits; some writers fill the lower 8 only, which libtiff accepts as well.
        let shift = if map.iter().all(|&v| v < 256) { 0 } else { 8 };
        let colour = |i: usize| [map[i] >> shift, map[256 + i] >> shift, map[512 + i] >> shift];
        Ok(Some((indexed, (0..256).map(colour).collect())))
    }

    fn plain_tiff(&self) -> Decoded {
        let mut decoder = Decoder::new(Cursor::new(self.bytes)).map_err(|e| self.tiff_error(e))?;
        // The defaults (256 MiB decoded, 128 MiB per strip) are too small for large sensors; the
        // size is checked here instead.
        let mut limits = Limits::default();
        let most = usize::try_from(8 * MAX_PIXELS).unwrap_or(usize::MAX);
        limits.decoding_buffer_size = most;
        limits.intermediate_buffer_size = most;
        limits.ifd_value_size = 64 << 20;
        decoder = decoder.with_limits(limits);
        let (width, height) = decoder.dimensions().map_err(|e| self.tiff_error(e))?;
        self.check_size(width, height)?;
        let channels = match decoder.colortype().map_err(|e| self.tiff_error(e))? {
            ColorType::Gray(8 | 16) => 1,
            ColorType::GrayA(8 | 16) => 2,
            ColorType::RGB(8 | 16) => 3,
            ColorType::RGBA(8 | 16) => 4,
            other => return Err(self.unsupported(format!("a TIFF of type {other:?}"))),
        };
        let description = decoder.get_tag_ascii_string(Tag::ImageDescription).unwrap_or_default();
        let image = decoder.read_image().map_err(|e| self.tiff_error(e))?;
        let (container_bits, samples) = match image {
            DecodingResult::U8(v) => (8, v.into_iter().map(u16::from).collect()),
            DecodingResult::U16(v) => (16, v),
            _ => return Err(self.unsupported("a TIFF whose samples are not unsigned integers")),
        };
        let (mut image, mut notes) = self.grey(width, height, container_bits, channels, samples)?;
        if let Some(bits) = significant_bits_of(&description) {
            image.significant_bits = bits.min(container_bits);
        }
        if decoder.more_images() {
            notes.push(ReadNote::FirstPageOnly);
        }
        Ok((image, notes))
    }

    fn png(&self) -> Decoded {
        // Depths below 8 would be stretched to 0..=255 by the decoder.
        match self.bytes.get(24) {
            None => return Err(self.truncated("its header is incomplete")),
            Some(&depth @ (1 | 2 | 4)) if self.bytes.get(25) != Some(&3) => {
                return Err(self.unsupported(format!("a PNG of {depth} bits per pixel")));
            }
            Some(_) => {}
        }
        self.raster(ImageFormat::Png)
    }

    fn raster(&self, format: ImageFormat) -> Decoded {
        let reader = || {
            let mut reader = image::ImageReader::with_format(Cursor::new(self.bytes), format);
            // The default of 512 MiB is too small for large sensors; see MAX_PIXELS.
            let mut limits = image::Limits::default();
            limits.max_alloc = Some(8 * MAX_PIXELS);
            reader.limits(limits);
            reader
        };
        let image_error = |error: image::ImageError| match error {
            image::ImageError::IoError(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
                self.truncated("the decoder ran out of data")
            }
            image::ImageError::Unsupported(e) => self.unsupported(e),
            other => self.damaged(other),
        };
        let (width, height) = reader().into_dimensions().map_err(image_error)?;
        self.check_size(width, height)?;
        let widen = |v: Vec<u8>| v.into_iter().map(u16::from).collect();
        let (bits, channels, samples) = match reader().decode().map_err(image_error)? {
            DynamicImage::ImageLuma8(i) => (8, 1, widen(i.into_raw())),
            DynamicImage::ImageLumaA8(i) => (8, 2, widen(i.into_raw())),
            DynamicImage::ImageRgb8(i) => (8, 3, widen(i.into_raw())),
            DynamicImage::ImageRgba8(i) => (8, 4, widen(i.into_raw())),
            DynamicImage::ImageLuma16(i) => (16, 1, i.into_raw()),
            DynamicImage::ImageLumaA16(i) => (16, 2, i.into_raw()),
            DynamicImage::ImageRgb16(i) => (16, 3, i.into_raw()),
            DynamicImage::ImageRgba16(i) => (16, 4, i.into_raw()),
            _ => return Err(self.unsupported("an image of floating-point samples")),
        };
        self.grey(width, height, bits, channels, samples)
    }

    /// Takes interleaved samples of 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGB, alpha) channels.
    fn grey(&self, width: u32, height: u32, bits: u8, channels: usize, samples: Vec<u16>) -> Decoded {
        let pixels = width as usize * height as usize;
        if samples.len() != pixels * channels {
            return Err(self.truncated(format!(
                "{} of {} samples present",
                samples.len(),
                pixels * channels
            )));
        }
        let mut notes = Vec::new();
        let data = match channels {
            1 => samples,
            2 => samples.chunks_exact(2).map(|p| p[0]).collect(),
            _ => {
                let pixels = samples.chunks_exact(channels);
                if pixels.clone().all(|p| p[0] == p[1] && p[1] == p[2]) {
                    pixels.map(|p| p[0]).collect()
                } else {
                    notes.push(ReadNote::ColourConverted);
                    pixels.map(|p| luminance(p[0], p[1], p[2])).collect()
                }
            }
        };
        if channels.is_multiple_of(2) {
            notes.push(ReadNote::AlphaDropped);
        }
        let image = GreyImage { width, height, container_bits: bits, significant_bits: bits, data };
        Ok((image, notes))
    }
}

/// Rec. 709 luminance of gamma-free values, rounded to nearest.
fn luminance(r: u16, g: u16, b: u16) -> u16 {
    let sum = 2126 * u64::from(r) + 7152 * u64::from(g) + 722 * u64::from(b) + 5000;
    u16::try_from(sum / 10_000).unwrap_or(u16::MAX)
}

/// Where the value of PhotometricInterpretation stands in a classic TIFF.
fn photometric_offset(bytes: &[u8]) -> Option<usize> {
    const PHOTOMETRIC: u16 = 262;
    const SHORT: u16 = 3;
    let little = match bytes {
        [b'I', b'I', 42, 0, ..] => true,
        [b'M', b'M', 0, 42, ..] => false,
        _ => return None,
    };
    let short = |at: usize| {
        let pair = bytes.get(at..at.checked_add(2)?)?.try_into().ok()?;
        Some(if little { u16::from_le_bytes(pair) } else { u16::from_be_bytes(pair) })
    };
    let quad = bytes.get(4..8)?.try_into().ok()?;
    let offset = if little { u32::from_le_bytes(quad) } else { u32::from_be_bytes(quad) };
    let directory = usize::try_from(offset).ok()?;
    let entries = usize::from(short(directory)?);
    let entry = (0..entries)
        .map_while(|i| directory.checked_add(2 + 12 * i))
        .find(|&entry| short(entry) == Some(PHOTOMETRIC) && short(entry + 2) == Some(SHORT))?;
    short(entry + 8).map(|_| entry + 8)
}

/// Our own frames state the camera's bit depth in the TIFF description, as JSON.
fn significant_bits_of(description: &str) -> Option<u8> {
    let value: serde_json::Value = serde_json::from_str(description.trim_end_matches('\0')).ok()?;
    let bits = u8::try_from(value.get("significant_bits")?.as_u64()?).ok()?;
    (bits > 0).then_some(bits)
}
