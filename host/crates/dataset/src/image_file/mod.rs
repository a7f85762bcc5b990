//! Grey images: 8- and 16-bit TIFF, PNG and BMP, read without any scaling of the grey values.
//!
//! The format is recognised by content, not by the name of the file. A grey value in the file is
//! the grey value in [`GreyImage::data`]: an 8-bit image gives 0..=255, a 12-bit camera image in a
//! 16-bit container gives 0..=4095. Indices into a palette are looked up.

mod decode;

use std::io::{self, Cursor};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageFormat};
use thiserror::Error;
use tiff::TiffError;
use tiff::decoder::Decoder;
use tiff::encoder::{TiffEncoder, colortype};
use tiff::tags::Tag;

use crate::atomic::{self, WriteError};

/// Largest image that is read, in pixels (2^29, twice the largest sensors on the market): what is
/// beyond is a damaged header or a mistake, and would exhaust the memory.
pub const MAX_PIXELS: u64 = 1 << 29;

/// A grey image, row-major, `data[y * width + x]`, pixel (0, 0) at the top left.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GreyImage {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Bits per pixel in the file: 8 or 16.
    pub container_bits: u8,
    /// Bits that carry information, at most `container_bits` (12 for a 12-bit camera, where the
    /// file says so; else equal to `container_bits`). Saturation is at `2^significant_bits - 1`.
    pub significant_bits: u8,
    /// Grey values as in the file.
    pub data: Vec<u16>,
}

/// Something the reader did that a careful user wants to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReadNote {
    /// A colour image was converted to grey by Rec. 709 luminance,
    /// (2126 R + 7152 G + 722 B) / 10000 rounded. Bayer or lamp colours bias such an image.
    ColourConverted,
    /// An alpha channel was dropped.
    AlphaDropped,
    /// Only the first of several pages was read.
    FirstPageOnly,
}

/// Why an image could not be read or written; every variant names the file.
#[derive(Debug, Error)]
pub enum ImageFileError {
    /// There is no such file.
    #[error("image file {} does not exist; check the path", path.display())]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// The system refused to read it (permissions, a folder, a broken device).
    #[error("cannot read image file {}: {source}; check that it is a file and may be read", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The file has no content.
    #[error("image file {} is empty (0 bytes): its recording or copy was interrupted", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The file ends before the image does.
    #[error(
        "image file {} is truncated: it ends after {bytes} bytes, before the image does ({reason}); copy or record it again",
        path.display()
    )]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Its length in bytes.
        bytes: u64,
        /// What was missing.
        reason: String,
    },
    /// The content begins like no image format known here.
    #[error("{} is not an image: it begins like no TIFF, PNG or BMP file", path.display())]
    NotAnImage {
        /// The file.
        path: PathBuf,
    },
    /// An image, but of a kind that is not read.
    #[error(
        "image file {} is {kind}, which is not supported; convert it to an 8- or 16-bit grey TIFF, PNG or BMP",
        path.display()
    )]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The kind found.
        kind: String,
    },
    /// The image is larger than [`MAX_PIXELS`].
    #[error(
        "image file {} claims {width} x {height} pixels; at most {MAX_PIXELS} pixels are read",
        path.display()
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Width in its header.
        width: u32,
        /// Height in its header.
        height: u32,
    },
    /// The content contradicts its format.
    #[error("image file {} is damaged: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What the decoder found.
        reason: String,
    },
    /// The pixels handed over do not fit the stated size.
    #[error("cannot write {}: {pixels} grey values for an image of {width} x {height} pixels", path.display())]
    Shape {
        /// The file that was to be written.
        path: PathBuf,
        /// Stated width.
        width: u32,
        /// Stated height.
        height: u32,
        /// Number of grey values handed over.
        pixels: usize,
    },
    /// The encoder refused.
    #[error("cannot encode {}: {reason}", path.display())]
    Encode {
        /// The file that was to be written.
        path: PathBuf,
        /// What the encoder said.
        reason: String,
    },
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Reads a grey image; see [`read_grey_noted`] to learn of conversions.
///
/// # Errors
/// [`ImageFileError`], naming file and reason.
pub fn read_grey(path: &Path) -> Result<GreyImage, ImageFileError> {
    read_grey_noted(path).map(|(image, _)| image)
}

/// Reads a grey image and says what was converted or dropped on the way.
///
/// Colour images whose three channels are equal everywhere (grey stored as RGB, as 8-bit BMP
/// often is) give that channel, without a note.
///
/// # Errors
/// [`ImageFileError`], naming file and reason.
pub fn read_grey_noted(path: &Path) -> Result<(GreyImage, Vec<ReadNote>), ImageFileError> {
    let bytes = std::fs::read(path).map_err(|source| match source.kind() {
        io::ErrorKind::NotFound => ImageFileError::Missing { path: path.to_path_buf() },
        _ => ImageFileError::Unreadable { path: path.to_path_buf(), source },
    })?;
    decode_grey(&bytes, path)
}

/// Decodes a grey image from memory; `path` only names it in errors.
///
/// # Errors
/// [`ImageFileError`], naming file and reason.
pub fn decode_grey(bytes: &[u8], path: &Path) -> Result<(GreyImage, Vec<ReadNote>), ImageFileError> {
    if bytes.is_empty() {
        return Err(ImageFileError::Empty { path: path.to_path_buf() });
    }
    decode::decode(bytes, path)
}

/// Text for a TIFF description, which must be 7-bit ASCII: JSON with everything else escaped.
pub(crate) fn ascii_json(value: &serde_json::Value) -> String {
    let mut out = String::new();
    for c in value.to_string().chars() {
        if c.is_ascii() {
            out.push(c);
        } else {
            for unit in c.encode_utf16(&mut [0; 2]) {
                out.push_str(&format!("\\u{unit:04x}"));
            }
        }
    }
    out
}

fn check_shape(path: &Path, width: u32, height: u32, pixels: usize) -> Result<(), ImageFileError> {
    if pixels == 0 || u64::from(width) * u64::from(height) != pixels as u64 {
        return Err(ImageFileError::Shape { path: path.to_path_buf(), width, height, pixels });
    }
    Ok(())
}

/// Writes a recorded frame as TIFF in its own container (8 or 16 bit, uncompressed), with
/// `{"significant_bits": n}` as description, so that [`read_grey`] gives back an equal image.
///
/// # Errors
/// [`ImageFileError`]; nothing is left half-written. Values above 255 in an 8-bit container are
/// an [`ImageFileError::Encode`].
pub fn write_frame(path: &Path, image: &GreyImage) -> Result<(), ImageFileError> {
    let description = format!("{{\"significant_bits\":{}}}", image.significant_bits);
    if image.container_bits > 8 {
        return write_tiff16(path, image.width, image.height, &image.data, Some(&description));
    }
    check_shape(path, image.width, image.height, image.data.len())?;
    let narrow: Result<Vec<u8>, _> = image.data.iter().map(|&v| u8::try_from(v)).collect();
    let narrow = narrow.map_err(|_| ImageFileError::Encode {
        path: path.to_path_buf(),
        reason: "a grey value above 255 in an image declared as 8 bit".into(),
    })?;
    write_tiff::<colortype::Gray8>(path, image.width, image.height, &narrow, Some(&description))
}

/// Writes a 16-bit grey TIFF, uncompressed; `description` must be ASCII without NUL.
///
/// # Errors
/// [`ImageFileError`]; nothing is left half-written.
pub fn write_tiff16(
    path: &Path,
    width: u32,
    height: u32,
    data: &[u16],
    description: Option<&str>,
) -> Result<(), ImageFileError> {
    check_shape(path, width, height, data.len())?;
    write_tiff::<colortype::Gray16>(path, width, height, data, description)
}

fn write_tiff<C>(
    path: &Path,
    width: u32,
    height: u32,
    data: &[C::Inner],
    description: Option<&str>,
) -> Result<(), ImageFileError>
where
    C: colortype::ColorType,
    [C::Inner]: tiff::encoder::TiffValue,
{
    let mut bytes = Vec::with_capacity(size_of_val(data) + 1024);
    encode_tiff::<C>(&mut bytes, width, height, data, description)
        .map_err(|e| ImageFileError::Encode { path: path.to_path_buf(), reason: e.to_string() })?;
    Ok(atomic::write_bytes(path, &bytes)?)
}

fn encode_tiff<C>(
    bytes: &mut Vec<u8>,
    width: u32,
    height: u32,
    data: &[C::Inner],
    description: Option<&str>,
) -> Result<(), TiffError>
where
    C: colortype::ColorType,
    [C::Inner]: tiff::encoder::TiffValue,
{
    let mut encoder = TiffEncoder::new(Cursor::new(bytes))?;
    let mut image = encoder.new_image::<C>(width, height)?;
    if let Some(text) = description {
        image.encoder().write_tag(Tag::ImageDescription, text)?;
    }
    image.write_data(data)
}

/// Writes a 16-bit grey PNG.
///
/// # Errors
/// [`ImageFileError`]; nothing is left half-written.
pub fn write_png16(path: &Path, width: u32, height: u32, data: &[u16]) -> Result<(), ImageFileError> {
    check_shape(path, width, height, data.len())?;
    let image = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(width, height, data.to_vec());
    write_png(path, image.map(DynamicImage::ImageLuma16))
}

/// Writes an 8-bit grey PNG.
///
/// # Errors
/// [`ImageFileError`]; nothing is left half-written.
pub fn write_png8(path: &Path, width: u32, height: u32, data: &[u8]) -> Result<(), ImageFileError> {
    check_shape(path, width, height, data.len())?;
    write_png(path, image::GrayImage::from_raw(width, height, data.to_vec()).map(DynamicImage::from))
}

fn write_png(path: &Path, image: Option<DynamicImage>) -> Result<(), ImageFileError> {
    let encode = |reason: String| ImageFileError::Encode { path: path.to_path_buf(), reason };
    let image = image.ok_or_else(|| encode("size and number of grey values differ".into()))?;
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, ImageFormat::Png).map_err(|e| encode(e.to_string()))?;
    Ok(atomic::write_bytes(path, bytes.get_ref())?)
}

/// The ImageDescription of a TIFF file, if there is one.
pub(crate) fn read_description(path: &Path) -> Option<String> {
    let bytes = std::fs::read(path).ok()?;
    catch_unwind(AssertUnwindSafe(|| {
        let mut decoder = Decoder::new(Cursor::new(&bytes)).ok()?;
        let text = decoder.get_tag_ascii_string(Tag::ImageDescription).ok()?;
        Some(text.trim_end_matches('\0').to_string())
    }))
    .ok()
    .flatten()
}
