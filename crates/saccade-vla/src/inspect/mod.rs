//! Looking inside a head: what to change while it runs, and what to keep.

pub(crate) mod changes;
mod check;
pub(crate) mod extent;
pub(crate) mod groups;
pub(crate) mod intervention;
pub mod linalg;
#[cfg(test)]
mod tests;
pub(crate) mod trace;
