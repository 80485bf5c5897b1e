//! Messages: what they say, that they end, and that they do nothing to a terminal.

use std::error::Error as _;

use saccade_vla_checkpoint::{Error, Problem, probe_allocation, problem, show_bytes};

/// Lines of a message that are shown, and characters of the beginning and of the end of a line.
const MAX_LINES: usize = 1000;
const MAX_LINE: usize = 1000;

#[test]
fn messages_do_nothing_to_a_terminal() {
    let error = Error::Checkpoint(Problem::new(
        "source",
        "2 tensors:\n  a\u{1b}[2Jb is unknown\n  c\r\u{202e}d\u{9b}",
    ));
    let expected = "source: 2 tensors:\n  a\\u{1b}[2Jb is unknown\n  c\\u{d}\\u{202e}d\\u{9b}";
    assert_eq!(error.to_string(), expected);
    let error = Error::NotFound {
        what: "source",
        path: "a\u{7}".into(),
    };
    assert_eq!(error.to_string(), "source: no such file or directory: a\\u{7}");
}

#[test]
fn long_messages_end() {
    let (begin, end) = ("a".repeat(MAX_LINE), "e".repeat(MAX_LINE));
    let shown = Error::Input(format!("{begin}{}{end}", "m".repeat(10 * MAX_LINE)).into()).to_string();
    assert_eq!(shown, format!("{begin}...{end}"));
    assert_eq!(
        Error::Input(format!("{begin}{end}").into()).to_string(),
        format!("{begin}{end}")
    );
    let many = "a line\n".repeat(10 * MAX_LINES);
    let shown = Error::Input(many.clone().into()).to_string();
    assert_eq!(shown.lines().count(), MAX_LINES + 1);
    assert!(many.starts_with(shown.strip_suffix("  ...").unwrap()));
    let all = "a line with \"quotes\", tabs not, \u{e4}\u{3b1}\u{4e2d}\n".repeat(MAX_LINES);
    assert_eq!(Error::Input(all.clone().into()).to_string(), all);
}

#[test]
fn problems_say_what_they_are_about() {
    let given = 3;
    let problem = problem!("count"; expected "at most {}", 2; got "{given}");
    assert_eq!(problem.to_string(), "count: expected at most 2, got 3");
    assert_eq!(
        (problem.argument(), problem.sides()),
        (Some("count"), Some(("at most 2", "3")))
    );
    let problem = problem!("out"; "{given} is there");
    assert_eq!(
        (problem.to_string().as_str(), problem.sides()),
        ("out: 3 is there", None)
    );
    assert_eq!(
        problem!("options"; "\n  a\n  b").to_string(),
        "options:\n  a\n  b"
    );
    let problem = Problem::from("stopped".to_owned());
    assert_eq!(
        (problem.to_string().as_str(), problem.argument()),
        ("stopped", None)
    );
}

#[test]
fn sizes_have_suitable_units() {
    assert_eq!(show_bytes(999), "999 bytes of memory");
    assert_eq!(show_bytes(12_345_678), "12345678 bytes of memory (12.3 MB)");
    let error = probe_allocation("source", usize::MAX).unwrap_err().to_string();
    assert_eq!(
        error,
        "source: cannot allocate 18446744073709551615 bytes of memory (18.4 EB)"
    );
}

#[test]
fn causes_are_kept() {
    let error = Error::Output {
        path: "a".into(),
        source: std::io::Error::other("the reason"),
    };
    assert_eq!(error.source().unwrap().to_string(), "the reason");
    assert_eq!(error.to_string(), "out: a cannot be written: the reason");
}
