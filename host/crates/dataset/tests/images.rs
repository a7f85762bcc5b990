//! Image files: round trips, formats, and what damaged files give.

use std::fs;
use std::path::Path;

use daic_dataset::image_file::{
    decode_grey, read_grey_noted, write_frame, write_png8, write_png16, write_tiff16,
};
use daic_dataset::{GreyImage, ImageFileError, ReadNote, read_grey};

/// Numbers that look random and are the same everywhere (xorshift64).
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }
}

fn frame(width: u32, height: u32, bits: u8) -> GreyImage {
    let mut noise = Noise(0x9e37_79b9_7f4a_7c15);
    let most = (1u64 << bits) - 1;
    let data = (0..width * height).map(|_| (noise.next() & most) as u16).collect();
    GreyImage { width, height, container_bits: if bits > 8 { 16 } else { 8 }, significant_bits: bits, data }
}

#[test]
fn frames_come_back_as_they_went() {
    let dir = tempfile::tempdir().unwrap();
    for bits in [8, 10, 12, 16] {
        let path = dir.path().join(format!("{bits}.tif"));
        let image = frame(37, 23, bits);
        write_frame(&path, &image).unwrap();
        assert_eq!(read_grey(&path).unwrap(), image);
    }
    let image = frame(37, 23, 16);
    let path = dir.path().join("16.png");
    write_png16(&path, 37, 23, &image.data).unwrap();
    assert_eq!(read_grey(&path).unwrap(), image);
    let image = frame(37, 23, 8);
    let narrow: Vec<u8> = image.data.iter().map(|&v| v as u8).collect();
    // The content decides, not the name.
    let path = dir.path().join("8.tif");
    write_png8(&path, 37, 23, &narrow).unwrap();
    assert_eq!(read_grey(&path).unwrap(), image);
}

#[test]
fn grey_values_are_never_scaled() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("dark.tif");
    let data: Vec<u16> = (0..100).collect();
    write_tiff16(&path, 10, 10, &data, None).unwrap();
    let image = read_grey(&path).unwrap();
    assert_eq!(image.data, data);
    assert_eq!((image.container_bits, image.significant_bits), (16, 16));
}

#[test]
fn bmp_grey_and_colour() {
    let dir = tempfile::tempdir().unwrap();
    let grey = image::GrayImage::from_fn(9, 5, |x, y| image::Luma([(x * 20 + y) as u8]));
    let path = dir.path().join("grey.bmp");
    grey.save(&path).unwrap();
    let (read, notes) = read_grey_noted(&path).unwrap();
    assert_eq!(read.data, grey.iter().map(|&v| u16::from(v)).collect::<Vec<_>>());
    assert_eq!((read.container_bits, notes), (8, vec![]));

    let colour =
        image::RgbImage::from_fn(2, 1, |x, _| image::Rgb(if x == 0 { [255, 0, 0] } else { [10, 200, 30] }));
    for name in ["colour.bmp", "colour.png", "colour.tif"] {
        let path = dir.path().join(name);
        colour.save(&path).unwrap();
        let (read, notes) = read_grey_noted(&path).unwrap();
        // 0.2126 * 255 = 54.2; 2.126 + 143.04 + 2.166 = 147.3.
        assert_eq!((read.data, notes), (vec![54, 147], vec![ReadNote::ColourConverted]), "{name}");
    }
    let alpha = image::GrayAlphaImage::from_pixel(2, 2, image::LumaA([77, 3]));
    let path = dir.path().join("alpha.png");
    alpha.save(&path).unwrap();
    let (read, notes) = read_grey_noted(&path).unwrap();
    assert_eq!((read.data, notes), (vec![77; 4], vec![ReadNote::AlphaDropped]));
}

#[test]
fn every_fault_has_its_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.tif");
    let fault = |bytes: &[u8]| decode_grey(bytes, &path).unwrap_err();
    assert!(matches!(read_grey(&path).unwrap_err(), ImageFileError::Missing { .. }));
    assert!(matches!(read_grey(dir.path()).unwrap_err(), ImageFileError::Unreadable { .. }));
    assert!(matches!(fault(b""), ImageFileError::Empty { .. }));
    assert!(matches!(fault(b"x,y,u,v\n1,2,3,4\n"), ImageFileError::NotAnImage { .. }));
    assert!(matches!(fault(b"\xff\xd8\xff\xe0\x00\x10JFIF"), ImageFileError::Unsupported { .. }));
    assert!(matches!(fault(b"\x89PNG"), ImageFileError::Truncated { .. }));
    assert!(matches!(write_tiff16(&path, 3, 3, &[0; 8], None), Err(ImageFileError::Shape { .. })));
    assert!(matches!(write_tiff16(&path, 1, 1, &[0], Some("µ")), Err(ImageFileError::Encode { .. })));
    assert!(!path.exists(), "nothing half-written");

    write_png16(&path, 64, 64, &frame(64, 64, 16).data).unwrap();
    let png = fs::read(&path).unwrap();
    assert!(
        matches!(fault(&png[..png.len() / 2]), ImageFileError::Truncated { .. }),
        "{}",
        fault(&png[..png.len() / 2])
    );
    // A header that claims 60000 x 60000 pixels, with its checksum mended.
    let mut large = png.clone();
    large[16..20].copy_from_slice(&60_000u32.to_be_bytes());
    large[20..24].copy_from_slice(&60_000u32.to_be_bytes());
    let sum = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&large[12..29]);
    large[29..33].copy_from_slice(&sum.to_be_bytes());
    assert!(matches!(fault(&large), ImageFileError::TooLarge { .. }), "{}", fault(&large));
    // A flipped bit in the pixels is seen by the checksum.
    let mut flipped = png;
    let middle = flipped.len() / 2;
    flipped[middle] ^= 1;
    assert!(matches!(fault(&flipped), ImageFileError::Damaged { .. }), "{}", fault(&flipped));
    for error in [fault(b""), fault(b"abc")] {
        assert!(error.to_string().contains("x.tif"));
    }
    // Floating-point TIFF is not silently rounded.
    let mut float = std::io::Cursor::new(Vec::new());
    tiff::encoder::TiffEncoder::new(&mut float)
        .unwrap()
        .write_image::<tiff::encoder::colortype::Gray32Float>(2, 2, &[0.5; 4])
        .unwrap();
    assert!(matches!(fault(float.get_ref()), ImageFileError::Unsupported { .. }));
}

#[test]
fn only_the_first_page_is_read_and_that_is_said() {
    let mut stack = std::io::Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut stack).unwrap();
    for page in 0..2u8 {
        encoder.write_image::<tiff::encoder::colortype::Gray8>(2, 2, &[page; 4]).unwrap();
    }
    let (image, notes) = decode_grey(stack.get_ref(), Path::new("stack.tif")).unwrap();
    assert_eq!((image.data, notes), (vec![0; 4], vec![ReadNote::FirstPageOnly]));
}

/// An 8-bit TIFF of palette indices, as IrfanView and old cameras write them, in either byte order.
fn palette_tiff(little: bool, map: &[u16], pixels: &[u8]) -> Vec<u8> {
    let mut out = if little { b"II\x2a\x00".to_vec() } else { b"MM\x00\x2a".to_vec() };
    let short = |v: u16| if little { v.to_le_bytes() } else { v.to_be_bytes() };
    let long = |v: u32| if little { v.to_le_bytes() } else { v.to_be_bytes() };
    let map_at = 8;
    let data_at = map_at + 2 * map.len() as u32;
    out.extend(long(data_at + pixels.len() as u32));
    map.iter().for_each(|&v| out.extend(short(v)));
    out.extend(pixels);
    let mut shorts =
        vec![(256, pixels.len() as u16), (257, 1), (258, 8), (259, 1), (262, 3), (277, 1), (278, 1)];
    out.extend(short(10));
    shorts.drain(..5).for_each(|(tag, v)| {
        out.extend([short(tag), short(3)].concat());
        out.extend(long(1));
        out.extend([short(v), short(0)].concat());
    });
    let mut entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        out.extend([short(tag), short(kind)].concat());
        out.extend([long(count), value].concat());
    };
    entry(273, 4, 1, long(data_at));
    for (tag, v) in shorts {
        let [a, b] = short(v);
        entry(tag, 3, 1, [a, b, 0, 0]);
    }
    entry(279, 4, 1, long(pixels.len() as u32));
    entry(320, 3, map.len() as u32, long(map_at));
    out.extend(long(0));
    out
}

#[test]
fn palettes_are_looked_up() {
    let path = Path::new("palette.tif");
    let pixels: Vec<u8> = (0..=255).collect();
    for little in [true, false] {
        // Full-range, upper-byte and lower-byte palettes all mean the same greys.
        for factor in [257, 256, 1] {
            let falling: Vec<u16> = (0..256).map(|i| (255 - i) * factor).collect();
            let bytes = palette_tiff(little, &falling.repeat(3), &pixels);
            let (image, notes) = decode_grey(&bytes, path).unwrap();
            assert_eq!((image.data, notes), ((0..256).rev().collect(), vec![]), "factor {factor}");
        }
        let mut red = vec![0u16; 768];
        red[..256].fill(u16::MAX);
        let (image, notes) = decode_grey(&palette_tiff(little, &red, &pixels), path).unwrap();
        assert_eq!((image.data, notes), (vec![54; 256], vec![ReadNote::ColourConverted]));
        let short = palette_tiff(little, &red[..700], &pixels);
        assert!(matches!(decode_grey(&short, path), Err(ImageFileError::Damaged { .. })));
    }
}

/// The same small image in every format that is read.
fn samples() -> Vec<(&'static str, Vec<u8>)> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("f");
    let image = frame(23, 17, 8);
    let narrow: Vec<u8> = image.data.iter().map(|&v| v as u8).collect();
    let mut files = Vec::new();
    write_frame(&path, &image).unwrap();
    files.push(("tiff", fs::read(&path).unwrap()));
    write_png8(&path, 23, 17, &narrow).unwrap();
    files.push(("png", fs::read(&path).unwrap()));
    let mut bmp = std::io::Cursor::new(Vec::new());
    image::GrayImage::from_raw(23, 17, narrow.clone())
        .unwrap()
        .write_to(&mut bmp, image::ImageFormat::Bmp)
        .unwrap();
    files.push(("bmp", bmp.into_inner()));
    for (name, compression) in [
        ("tiff deflate", tiff::encoder::Compression::Deflate(tiff::encoder::DeflateLevel::Fast)),
        ("tiff lzw", tiff::encoder::Compression::Lzw),
    ] {
        let mut bytes = std::io::Cursor::new(Vec::new());
        tiff::encoder::TiffEncoder::new(&mut bytes)
            .unwrap()
            .with_compression(compression)
            .write_image::<tiff::encoder::colortype::Gray8>(23, 17, &narrow)
            .unwrap();
        files.push((name, bytes.into_inner()));
    }
    files
}

#[test]
fn cut_anywhere_a_file_is_refused_or_whole() {
    let expected = frame(23, 17, 8).data;
    for (name, bytes) in samples() {
        assert_eq!(decode_grey(&bytes, Path::new(name)).unwrap().0.data, expected, "{name}");
        let mut refused = 0;
        for length in 0..bytes.len() {
            match decode_grey(&bytes[..length], Path::new(name)) {
                // Trailers may go missing, pixels may not.
                Ok((image, _)) => assert_eq!(image.data, expected, "{name} cut to {length}"),
                Err(_) => refused += 1,
            }
        }
        assert!(refused * 10 >= bytes.len() * 9, "{name}: only {refused} of {} refused", bytes.len());
    }
}

#[test]
fn random_damage_never_panics() {
    let seed = 0x5eed_da1c_0000_0001;
    println!("seed {seed:#x}");
    let mut noise = Noise(seed);
    let path = Path::new("damaged");
    let ramp: Vec<u16> = (0..256).map(|i| i * 257).collect();
    let palette = palette_tiff(true, &ramp.repeat(3), &[1, 2, 3, 4]);
    for bytes in samples().into_iter().map(|(_, b)| b).chain([palette]) {
        for _ in 0..3000 {
            let mut bytes = bytes.clone();
            for _ in 0..=noise.next() % 4 {
                let at = match noise.next() % 3 {
                    // Headers are where damage hurts.
                    0 => noise.next() as usize % bytes.len(),
                    1 => noise.next() as usize % 64.min(bytes.len()),
                    _ => bytes.len() - 1 - noise.next() as usize % 200.min(bytes.len()),
                };
                bytes[at] = noise.next() as u8;
            }
            if let Ok((image, _)) = decode_grey(&bytes, path) {
                assert_eq!(image.data.len() as u64, u64::from(image.width) * u64::from(image.height));
            }
        }
    }
    for head in [&b"II\x2a\x00"[..], b"MM\x00\x2a", b"II\x2b\x00", b"\x89PNG\r\n\x1a\n", b"BM", b""] {
        for _ in 0..1000 {
            let mut bytes = head.to_vec();
            bytes.extend((0..noise.next() % 300).map(|_| noise.next() as u8));
            let _ = decode_grey(&bytes, path).is_ok();
        }
    }
}
