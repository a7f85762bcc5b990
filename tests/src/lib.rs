//! Tools of the whole-chain tests: the program as a user runs it, data of others, independent truths, the
//! reproduction of the thesis.

pub mod expansion;
pub mod hil;
pub mod program;
pub mod reproduce;
pub mod shared;
