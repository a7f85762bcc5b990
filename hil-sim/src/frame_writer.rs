//! Frames into a directory: one TIFF each, and a line in `frames.jsonl`.

use std::fs::{File, OpenOptions};
use std::io::{self, Cursor, Write};
use std::path::{Path, PathBuf};

use daic_hil_sim::SimFrame;
use image::{ImageBuffer, ImageFormat, Luma};
use serde::Serialize;

/// Writes frames as they come.
#[derive(Debug)]
pub struct FrameWriter {
    directory: PathBuf,
    lines: File,
    written: u64,
}

/// What a line of `frames.jsonl` holds: what the camera reports, and apart from it the truth.
#[derive(Serialize)]
struct Line<'a> {
    file: &'a str,
    id: u64,
    camera_ns: u64,
    width: usize,
    height: usize,
    bits: u8,
    truth: &'a daic_hil_sim::FrameTruth,
}

impl FrameWriter {
    /// Makes the directory if need be; lines are added to a list that is there already.
    pub fn open(directory: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(directory)?;
        let list = directory.join("frames.jsonl");
        let lines = OpenOptions::new().create(true).append(true).open(&list)?;
        let written = std::fs::read_to_string(&list)?.lines().count() as u64;
        Ok(Self { directory: directory.to_owned(), lines, written })
    }

    /// Where the frames go.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Writes one frame; its line follows once the image is complete.
    pub fn write(&mut self, frame: &SimFrame) -> io::Result<()> {
        // A frame delivered twice has one id and two files.
        let name = format!("frame_{:06}_id{:06}.tiff", self.written, frame.id);
        let (width, height) = (frame.width as u32, frame.height as u32);
        let image: ImageBuffer<Luma<u16>, &[u16]> =
            ImageBuffer::from_raw(width, height, &frame.data[..]).ok_or(io::ErrorKind::InvalidData)?;
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, ImageFormat::Tiff).map_err(io::Error::other)?;
        replace(&self.directory.join(&name), bytes.get_ref())?;
        let line = Line {
            file: &name,
            id: frame.id,
            camera_ns: frame.camera_ns,
            width: frame.width,
            height: frame.height,
            bits: frame.bits,
            truth: &frame.truth,
        };
        let mut text = serde_json::to_vec(&line).map_err(io::Error::other)?;
        text.push(b'\n');
        self.lines.write_all(&text)?;
        self.written += 1;
        Ok(())
    }
}

/// Writes a file under a temporary name, then renames it.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".tmp");
    std::fs::write(&temporary, bytes)?;
    std::fs::rename(&temporary, path)
}
