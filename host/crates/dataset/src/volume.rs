//! Volumes as files: TIFF stacks, OME-TIFF, OME-Zarr.
//!
//! A volume is `values[(z * height + y) * width + x]`, 32-bit floating point, written as it is: nothing is
//! rescaled.

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use serde_json::json;
use thiserror::Error;
use tiff::TiffError;
use tiff::decoder::{Decoder, DecodingResult};
use tiff::encoder::{TiffEncoder, TiffKind, colortype};
use tiff::tags::Tag;

use crate::atomic::{self, WriteError};

/// A volume on a regular grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Volume<'a> {
    /// (planes, rows, columns).
    pub shape: [usize; 3],
    /// Values as above.
    pub values: &'a [f32],
    /// Size (z, y, x) of a voxel, µm.
    pub voxel_um: [f64; 3],
    /// Depth of the first plane, µm.
    pub first_um: f64,
}

/// Why a volume could not be written.
#[derive(Debug, Error)]
pub enum VolumeError {
    /// The values do not fit the shape.
    #[error("cannot write {}: {values} values for a volume of {shape:?}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// (planes, rows, columns).
        shape: [usize; 3],
        /// Values handed over.
        values: usize,
    },
    /// The file is no stack.
    #[error("cannot read {}: {reason}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The encoder refused.
    #[error("cannot encode {}: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// What it said.
        reason: String,
    },
    /// The folder of a Zarr array is there already.
    #[error("{} exists already and is no OME-Zarr volume; choose another name", path.display())]
    Taken {
        /// The folder.
        path: PathBuf,
    },
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// Beyond this many bytes of values a TIFF needs 64-bit offsets.
const CLASSIC_TIFF: usize = 4_000_000_000;

impl Volume<'_> {
    fn check(&self, path: &Path) -> Result<(), VolumeError> {
        let count = self.shape.iter().try_fold(1usize, |a, b| a.checked_mul(*b));
        if self.values.is_empty() || count != Some(self.values.len()) {
            let (shape, values) = (self.shape, self.values.len());
            return Err(VolumeError::Shape { path: path.to_path_buf(), shape, values });
        }
        Ok(())
    }

    /// Writes a multi-page TIFF with the description that ImageJ understands.
    ///
    /// # Errors
    /// [`VolumeError`]; nothing is left half-written.
    pub fn write_tiff(&self, path: &Path) -> Result<(), VolumeError> {
        let [nz, ..] = self.shape;
        let largest = self.values.iter().copied().fold(0.0f32, f32::max);
        let description = format!(
            "ImageJ=1.53\nimages={nz}\nslices={nz}\nunit=um\nspacing={}\nmin=0\nmax={largest}\n",
            self.voxel_um[0]
        );
        self.write_pages(path, &description)
    }

    /// Writes an OME-TIFF.
    ///
    /// # Errors
    /// [`VolumeError`]; nothing is left half-written.
    pub fn write_ome_tiff(&self, path: &Path) -> Result<(), VolumeError> {
        let ([nz, ny, nx], [dz, dy, dx]) = (self.shape, self.voxel_um);
        let planes: String = (0..nz)
            .map(|z| {
                let at = self.first_um + z as f64 * dz;
                format!("<Plane TheC=\"0\" TheT=\"0\" TheZ=\"{z}\" PositionZ=\"{at}\" PositionZUnit=\"um\"/>")
            })
            .collect();
        let description = format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?><OME xmlns=\"http://www.openmicroscopy.org/Schemas/OME/2016-06\" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" xsi:schemaLocation=\"http://www.openmicroscopy.org/Schemas/OME/2016-06 http://www.openmicroscopy.org/Schemas/OME/2016-06/ome.xsd\"><Image ID=\"Image:0\" Name=\"volume\"><Pixels ID=\"Pixels:0\" DimensionOrder=\"XYZCT\" Type=\"float\" BigEndian=\"false\" SizeX=\"{nx}\" SizeY=\"{ny}\" SizeZ=\"{nz}\" SizeC=\"1\" SizeT=\"1\" PhysicalSizeX=\"{dx}\" PhysicalSizeXUnit=\"um\" PhysicalSizeY=\"{dy}\" PhysicalSizeYUnit=\"um\" PhysicalSizeZ=\"{dz}\" PhysicalSizeZUnit=\"um\"><Channel ID=\"Channel:0:0\" SamplesPerPixel=\"1\"/><TiffData IFD=\"0\" PlaneCount=\"{nz}\"/>{planes}</Pixels></Image></OME>"
        );
        // a description is ASCII: the micro sign is written out
        self.write_pages(path, &description.replace("Unit=\"um\"", "Unit=\"&#181;m\""))
    }

    fn write_pages(&self, path: &Path, description: &str) -> Result<(), VolumeError> {
        self.check(path)?;
        let encode = |e: TiffError| VolumeError::Encode { path: path.to_path_buf(), reason: e.to_string() };
        let mut bytes = Vec::with_capacity(size_of_val(self.values) + 4096);
        let cursor = Cursor::new(&mut bytes);
        if size_of_val(self.values) < CLASSIC_TIFF {
            self.pages(TiffEncoder::new(cursor).map_err(encode)?, description).map_err(encode)?;
        } else {
            self.pages(TiffEncoder::new_big(cursor).map_err(encode)?, description).map_err(encode)?;
        }
        Ok(atomic::write_bytes(path, &bytes)?)
    }

    fn pages<K: TiffKind>(
        &self,
        mut encoder: TiffEncoder<Cursor<&mut Vec<u8>>, K>,
        description: &str,
    ) -> Result<(), TiffError> {
        let [_, ny, nx] = self.shape;
        let size = |n: usize| u32::try_from(n).map_err(|_| TiffError::IntSizeError);
        let (width, height) = (size(nx)?, size(ny)?);
        for (z, plane) in self.values.chunks_exact(ny * nx).enumerate() {
            let mut image = encoder.new_image::<colortype::Gray32Float>(width, height)?;
            if z == 0 {
                image.encoder().write_tag(Tag::ImageDescription, description)?;
            }
            image.write_data(plane)?;
        }
        Ok(())
    }

    /// Writes a folder in the form of OME-Zarr 0.5 (Zarr 3): one uncompressed chunk for each plane. An
    /// OME-Zarr volume of that name is replaced.
    ///
    /// # Errors
    /// [`VolumeError`]; the folder appears only when it is complete.
    pub fn write_ome_zarr(&self, path: &Path) -> Result<(), VolumeError> {
        self.check(path)?;
        let [nz, ny, nx] = self.shape;
        let axis = |name: &str| json!({ "name": name, "type": "space", "unit": "micrometer" });
        let group = json!({
            "zarr_format": 3, "node_type": "group",
            "attributes": { "ome": { "version": "0.5", "multiscales": [{
                "name": "volume",
                "axes": [axis("z"), axis("y"), axis("x")],
                "datasets": [{ "path": "0", "coordinateTransformations": [
                    { "type": "scale", "scale": self.voxel_um },
                    { "type": "translation", "translation": [self.first_um, 0.0, 0.0] },
                ]}],
            }]}},
        });
        let array = json!({
            "zarr_format": 3, "node_type": "array", "shape": [nz, ny, nx], "data_type": "float32",
            "chunk_grid": { "name": "regular", "configuration": { "chunk_shape": [1, ny, nx] } },
            "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
            "fill_value": 0.0,
            "codecs": [{ "name": "bytes", "configuration": { "endian": "little" } }],
            "dimension_names": ["z", "y", "x"], "attributes": {},
        });
        if path.exists() && !path.join("zarr.json").exists() {
            return Err(VolumeError::Taken { path: path.to_path_buf() });
        }
        let mut name = path.as_os_str().to_owned();
        name.push(".part");
        let part = PathBuf::from(name);
        let failed = |path: &Path| {
            let path = path.to_path_buf();
            move |source| VolumeError::Write(WriteError::Content { path, source })
        };
        if part.exists() {
            fs::remove_dir_all(&part).map_err(failed(&part))?;
        }
        atomic::write_bytes(&part.join("zarr.json"), group.to_string().as_bytes())?;
        atomic::write_bytes(&part.join("0/zarr.json"), array.to_string().as_bytes())?;
        for (z, plane) in self.values.chunks_exact(ny * nx).enumerate() {
            let bytes: Vec<u8> = plane.iter().flat_map(|v| v.to_le_bytes()).collect();
            atomic::write_bytes(&part.join(format!("0/c/{z}/0/0")), &bytes)?;
        }
        if path.exists() {
            fs::remove_dir_all(path).map_err(failed(path))?;
        }
        fs::rename(&part, path).map_err(failed(path))
    }
}

/// Reads a stack of planes of 32-bit floating point numbers: values and (planes, rows, columns).
///
/// # Errors
/// [`VolumeError::Read`] for a file that cannot be read or is no such stack.
pub fn read_stack(path: &Path) -> Result<(Vec<f32>, [usize; 3]), VolumeError> {
    let failed = |reason: String| VolumeError::Read { path: path.to_path_buf(), reason };
    let bytes = fs::read(path).map_err(|e| failed(e.to_string()))?;
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(|e| failed(e.to_string()))?;
    let size = decoder.dimensions().map_err(|e| failed(e.to_string()))?;
    let (mut values, mut planes) = (Vec::new(), 0);
    loop {
        if decoder.dimensions().map_err(|e| failed(e.to_string()))? != size {
            return Err(failed(format!("plane {planes} has another size than the first")));
        }
        match decoder.read_image().map_err(|e| failed(e.to_string()))? {
            DecodingResult::F32(plane) => values.extend(plane),
            _ => return Err(failed(format!("plane {planes} does not hold 32-bit floating point numbers"))),
        }
        planes += 1;
        if !decoder.more_images() {
            return Ok((values, [planes, size.1 as usize, size.0 as usize]));
        }
        decoder.next_image().map_err(|e| failed(e.to_string()))?;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stacks_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let values: Vec<f32> = (0..3 * 4 * 5).map(|v| v as f32 * 0.5).collect();
        let volume = Volume { shape: [3, 4, 5], values: &values, voxel_um: [2.5, 1.5, 1.0], first_um: -2.5 };
        for (name, word) in [("a.tif", "slices=3"), ("a.ome.tif", "PhysicalSizeZ=\"2.5\"")] {
            let path = dir.path().join(name);
            if name.contains("ome") {
                volume.write_ome_tiff(&path).unwrap()
            } else {
                volume.write_tiff(&path).unwrap()
            }
            let mut decoder = Decoder::new(Cursor::new(fs::read(&path).unwrap())).unwrap();
            assert!(decoder.get_tag_ascii_string(Tag::ImageDescription).unwrap().contains(word));
            let (all, shape) = read_stack(&path).unwrap();
            assert_eq!(shape, volume.shape);
            assert_eq!(all, values);
        }
        let zarr = dir.path().join("a.ome.zarr");
        volume.write_ome_zarr(&zarr).unwrap();
        volume.write_ome_zarr(&zarr).unwrap();
        let chunk = fs::read(zarr.join("0/c/2/0/0")).unwrap();
        assert_eq!(chunk.len(), 80);
        assert_eq!(f32::from_le_bytes(chunk[..4].try_into().unwrap()), 20.0);
        let other = dir.path().join("folder");
        fs::create_dir(&other).unwrap();
        assert!(matches!(volume.write_ome_zarr(&other), Err(VolumeError::Taken { .. })));
        let short = Volume { values: &values[1..], ..volume };
        assert!(matches!(short.write_tiff(&dir.path().join("b.tif")), Err(VolumeError::Shape { .. })));
        assert!(!dir.path().join("b.tif").exists());
        fs::write(dir.path().join("c.tif"), b"II*").unwrap();
        assert!(matches!(read_stack(&dir.path().join("c.tif")), Err(VolumeError::Read { .. })));
    }
}
