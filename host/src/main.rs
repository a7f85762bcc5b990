//! The `daic` program.
fn main() {}
