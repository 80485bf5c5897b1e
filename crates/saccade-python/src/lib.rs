//! Python bindings of saccade.
#![deny(unsafe_code)]
