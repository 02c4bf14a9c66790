//! include/koopman.h is what cbindgen makes of the sources.
//!
//! After a change of the interface, `KOOPMAN_HEADER=write cargo test --test header` writes it.

use std::fs;
use std::path::Path;

#[test]
fn is_what_cbindgen_makes() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_file(folder.join("cbindgen.toml")).unwrap();
    let mut builder = cbindgen::Builder::new().with_config(config);
    for file in ["error.rs", "model.rs", "state.rs"] {
        builder = builder.with_src(folder.join("src").join(file));
    }
    let mut made = Vec::new();
    builder.generate().unwrap().write(&mut made);
    let made = String::from_utf8(made).unwrap();
    let path = folder.join("include/koopman.h");
    if std::env::var("KOOPMAN_HEADER").as_deref() == Ok("write") {
        fs::write(&path, &made).unwrap();
    }
    let found = fs::read_to_string(&path).unwrap_or_default();
    let line = (1..).zip(made.lines().zip(found.lines())).find(|(_, (made, found))| made != found);
    assert!(
        made == found,
        "include/koopman.h is not what cbindgen makes (first line that differs: {line:?}): \
         KOOPMAN_HEADER=write cargo test --test header writes it"
    );
}
