//! The C of the README is part of the example.

#[test]
fn excerpts_are_in_the_example() {
    let readme = include_str!("../../../README.md");
    let example = include_str!("../example/main.c");
    let mut count = 0;
    for block in readme.split("```c\n").skip(1) {
        let (excerpt, _) = block.split_once("```").unwrap();
        assert!(example.contains(excerpt), "not in example/main.c:\n{excerpt}");
        count += 1;
    }
    assert!(count > 0);
}
