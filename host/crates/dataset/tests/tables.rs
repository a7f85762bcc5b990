//! Tables and maps: round trips, damage, and the reference readers of Python.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use ndarray::Array1;
use ndarray_npy::NpzReader;

use daic_dataset::image_file::{write_frame, write_png8, write_png16};
use daic_dataset::map::write_maps_npz;
use daic_dataset::{Column, FloatMap, GreyImage, MapAxes, Table, TableError};

fn table() -> Table {
    let values = [0.1 + 0.2, -0.0, 5e-324, f64::MAX, f64::NAN, 1.0 / 3.0, f64::NEG_INFINITY];
    Table::new()
        .with("x", Column::I64(vec![i64::MIN, -1, 0, 1, 2, 3, i64::MAX]))
        .unwrap()
        .with("u", Column::F64(values.to_vec()))
        .unwrap()
        .with(
            "status",
            Column::Coded {
                codes: vec![0, 1, 0, 1, 0, 0, 1],
                legend: vec!["ok".into(), "low texture, \"blank\" µ".into()],
            },
        )
        .unwrap()
        .with("name", Column::Text(["a", "b", "a", "", "line\nbreak", "c", "a"].map(String::from).to_vec()))
        .unwrap()
}

fn bits(column: &Column) -> Vec<u64> {
    match column {
        Column::F64(v) => v.iter().map(|x| if x.is_nan() { u64::MAX } else { x.to_bits() }).collect(),
        other => panic!("not floats: {other:?}"),
    }
}

#[test]
fn csv_reads_back_to_the_bit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("points.csv");
    let table = table();
    table.write_csv(&path).unwrap();
    let back = Table::read_csv(&path).unwrap();
    assert_eq!(back.column("x"), table.column("x"));
    assert_eq!(bits(back.column("u").unwrap()), bits(table.column("u").unwrap()));
    for name in ["status", "name"] {
        assert_eq!(back.texts(name, &path).unwrap(), table.texts(name, &path).unwrap());
    }
    assert!(matches!(back.numbers("v", &path), Err(TableError::MissingColumn { .. })));
    assert!(matches!(back.numbers("name", &path), Err(TableError::NotNumeric { .. })));
    assert_eq!(back.numbers("x", &path).unwrap()[1], -1.0);
}

#[test]
fn npz_reads_back_to_the_bit_and_is_the_same_every_time() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("points.npz");
    let table = table();
    table.write_npz(&path).unwrap();
    let first = fs::read(&path).unwrap();
    table.write_npz(&path).unwrap();
    assert_eq!(fs::read(&path).unwrap(), first);
    // The time in the first entry's header is the constant 1980-01-01 00:00.
    assert_eq!(first[10..14], [0, 0, 0x21, 0]);
    let mut npz = NpzReader::new(fs::File::open(&path).unwrap()).unwrap();
    assert_eq!(npz.names().unwrap(), ["x", "u", "status", "status_legend", "name", "name_legend"]);
    let x: Array1<i64> = npz.by_name("x").unwrap();
    assert_eq!(&Column::I64(x.to_vec()), table.column("x").unwrap());
    let u: Array1<f64> = npz.by_name("u").unwrap();
    assert_eq!(bits(&Column::F64(u.to_vec())), bits(table.column("u").unwrap()));
    let mut legend = |name: &str| -> Vec<String> {
        let bytes: Array1<u8> = npz.by_name(name).unwrap();
        serde_json::from_slice(&bytes.to_vec()).unwrap()
    };
    let (status, name) = (legend("status_legend"), legend("name_legend"));
    let codes: Array1<u8> = npz.by_name("status").unwrap();
    let texts: Vec<_> = codes.iter().map(|&c| status[usize::from(c)].clone()).collect();
    assert_eq!(texts, table.texts("status", &path).unwrap());
    let codes: Array1<u32> = npz.by_name("name").unwrap();
    let texts: Vec<_> = codes.iter().map(|&c| name[c as usize].clone()).collect();
    assert_eq!(texts, table.texts("name", &path).unwrap());
}

#[test]
fn damaged_tables_are_errors() {
    let dir = tempfile::tempdir().unwrap();
    let csv = dir.path().join("t.csv");
    assert!(matches!(Table::read_csv(&csv), Err(TableError::Read { .. })));
    fs::write(&csv, "a,b\n1,2\n3\n").unwrap();
    let error = Table::read_csv(&csv).unwrap_err();
    assert!(matches!(error, TableError::Line { line: 3, .. }), "{error}");
    fs::write(&csv, b"a,b\n1,\xff\xfe\n").unwrap();
    assert!(matches!(Table::read_csv(&csv), Err(TableError::Line { .. })));
    fs::write(&csv, "a,a\n1,2\n").unwrap();
    assert!(matches!(Table::read_csv(&csv), Err(TableError::DuplicateColumn { .. })));
    fs::write(&csv, "").unwrap();
    assert_eq!(Table::read_csv(&csv).unwrap().rows(), 0);
}

/// The interpreter named by `DAIC_PYTHON`, or `python3`, if it has the reference readers.
fn python() -> Option<PathBuf> {
    let python = std::env::var_os("DAIC_PYTHON").map_or_else(|| PathBuf::from("python3"), PathBuf::from);
    let found = Command::new(&python).args(["-c", "import numpy, tifffile, PIL"]).output();
    found.is_ok_and(|o| o.status.success()).then_some(python)
}

#[test]
fn the_reference_readers_of_python_read_our_files() {
    let Some(python) = python() else {
        eprintln!(
            "SKIPPED the_reference_readers_of_python_read_our_files: no python3 with numpy, tifffile and pillow (set DAIC_PYTHON)"
        );
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    table().write_npz(&dir.path().join("points.npz")).unwrap();
    table().write_csv(&dir.path().join("points.csv")).unwrap();
    let data: Vec<u16> = (0..15).map(|i| i * 273).collect();
    let image = |bits| GreyImage {
        width: 5,
        height: 3,
        container_bits: if bits > 8 { 16 } else { 8 },
        significant_bits: bits,
        data: data.iter().map(|v| if bits > 8 { *v } else { *v / 17 }).collect(),
    };
    write_frame(&dir.path().join("f12.tif"), &image(12)).unwrap();
    write_frame(&dir.path().join("f8.tif"), &image(8)).unwrap();
    write_png16(&dir.path().join("f16.png"), 5, 3, &data).unwrap();
    let narrow: Vec<u8> = image(8).data.iter().map(|&v| v as u8).collect();
    write_png8(&dir.path().join("f8.png"), 5, 3, &narrow).unwrap();
    let map = FloatMap {
        name: "h_mm".into(),
        unit: "µm".into(),
        width: 3,
        height: 2,
        data: vec![1.0, 2.0, f64::NAN, -4.0, 0.25, 1.0 / 3.0],
        axes: MapAxes { x0: 0.0, dx: 1.0, y0: 0.0, dy: 1.0, unit: "mm".into() },
    };
    map.write_tiff(&dir.path().join("h.tif")).unwrap();
    write_maps_npz(&dir.path().join("maps.npz"), std::slice::from_ref(&map)).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/read_back.py");
    let run = Command::new(python).arg(script).arg(dir.path()).output().unwrap();
    let said = String::from_utf8_lossy(&run.stdout).into_owned() + &String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success() && said.contains("11 checks passed"), "{said}");
}
