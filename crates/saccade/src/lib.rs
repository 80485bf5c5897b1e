//! The action head of GR00T-style robot policies on CPUs.
#![forbid(unsafe_code)]
