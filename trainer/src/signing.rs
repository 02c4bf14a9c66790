//! Keys, and signed releases: who may install a model.
//!
//! A release is a model with a sequence number. Its owner signs the four
//! [statements](firmware_core::update::statement) about it, once, on a machine that holds the secret key;
//! whoever has the file with the signatures may install the model on the robots that trust the key, and
//! nothing else. Signatures are Ed25519 (RFC 8032): the same key, model and number give the same bytes.
//!
//! | file | content |
//! |---|---|
//! | NAME.key | `secret `, then the secret seed, 64 hexadecimal digits; read and written by its owner alone |
//! | NAME.pub | the public key, 64 hexadecimal digits |
//! | MODEL.sig | TOML: [`SignedRelease`] |

use std::fmt;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use ed25519_compact::{KeyPair, Seed};
use firmware_core::slots::{Release, robot, sha256};
use firmware_core::update::{PublicKey, Purpose, SIGNATURE, Signature, Trust, statement};
use serde::{Deserialize, Serialize};

use crate::report::hexadecimal;
use crate::robot::line_and_column;

/// The version of the file with the signatures.
pub const FORMAT: u32 = 1;
/// First word of a file with a secret key: a public one, of as many digits, must not be taken for it.
const SECRET: &str = "secret ";
/// Bytes of a key.
const KEY: usize = 32;

/// Why there is no key.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyError {
    /// The system gives no random numbers.
    #[error("the system gives no random numbers: {0}")]
    Random(String),
    /// A key is never overwritten: what it signed could not be followed by anything.
    #[error("{}: is there already, and a key is not overwritten; give another --out", .0.display())]
    Exists(PathBuf),
    /// The file cannot be read.
    #[error("{}: cannot be read: {error}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// The file cannot be written.
    #[error("{}: cannot be written: {error}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// The file holds a public key.
    #[error("{}: this is a public key; expected the secret one, NAME.key of `trainer keygen`", .0.display())]
    Public(PathBuf),
    /// The file holds no key.
    #[error(
        "{}: expected `secret` and 64 hexadecimal digits, as `trainer keygen` writes them", .0.display()
    )]
    Form(PathBuf),
}

/// A secret key, and the public one that belongs to it.
pub struct SecretKey(KeyPair);

impl fmt::Debug for SecretKey {
    /// The public key: the secret must not get into a log.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SecretKey(of {})", hexadecimal(&self.public().0))
    }
}

impl SecretKey {
    /// A new one, from the system's random numbers.
    ///
    /// # Errors
    /// [`KeyError::Random`].
    pub fn generate() -> Result<Self, KeyError> {
        let mut seed = [0; KEY];
        getrandom::fill(&mut seed).map_err(|error| KeyError::Random(error.to_string()))?;
        Self::from_seed(seed).ok_or_else(|| KeyError::Random("zeros alone".to_owned()))
    }

    /// That of a seed; `None` of one that is all zeros, which is no secret.
    ///
    /// ```
    /// use firmware_core::update::{PublicKey, Trust};
    /// use trainer::signing::SecretKey;
    /// let key = SecretKey::from_seed([7; 32]).unwrap();
    /// let statement = [1; 64];
    /// assert!(key.public().accepts(&statement, &key.sign(&statement)));
    /// assert!(!key.public().accepts(&[2; 64], &key.sign(&statement)));
    /// ```
    pub fn from_seed(seed: [u8; KEY]) -> Option<Self> {
        KeyPair::try_from_seed(Seed::new(seed)).ok().map(Self)
    }

    /// Reads NAME.key.
    ///
    /// # Errors
    /// [`KeyError`].
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        let text =
            std::fs::read(path).map_err(|error| KeyError::Read { path: path.to_owned(), error })?;
        let text = String::from_utf8_lossy(&text);
        if from_hexadecimal::<KEY>(text.trim()).is_some() {
            return Err(KeyError::Public(path.to_owned()));
        }
        let seed = text.trim().strip_prefix(SECRET).and_then(from_hexadecimal);
        seed.and_then(Self::from_seed).ok_or_else(|| KeyError::Form(path.to_owned()))
    }

    /// Writes NAME.key and NAME.pub, both or none; their names.
    ///
    /// # Errors
    /// [`KeyError::Exists`] if one of them is there, [`KeyError::Write`].
    pub fn write(&self, name: &Path) -> Result<(PathBuf, PathBuf), KeyError> {
        // Behind the name, whatever dots it has.
        let path = |ending: &str| {
            let mut path = name.as_os_str().to_owned();
            path.push(ending);
            PathBuf::from(path)
        };
        let (secret, public) = (path(".key"), path(".pub"));
        for path in [&secret, &public] {
            if path.symlink_metadata().is_ok() {
                return Err(KeyError::Exists(path.clone()));
            }
        }
        write_new(&secret, &format!("{SECRET}{}\n", hexadecimal(&*self.0.sk.seed())), 0o600)?;
        let written = write_new(&public, &format!("{}\n", hexadecimal(&self.public().0)), 0o666);
        if written.is_err() {
            // It has signed nothing yet; one that will not go is no further news.
            let _ = std::fs::remove_file(&secret);
        }
        written.map(|()| (secret, public))
    }

    /// The public key, as a controller trusts it.
    pub fn public(&self) -> PublicKey {
        PublicKey(*self.0.pk)
    }

    /// The signature of a message.
    pub fn sign(&self, message: &[u8]) -> [u8; SIGNATURE] {
        // Without noise: the same message has the same signature, as in RFC 8032.
        *self.0.sk.sign(message, None)
    }
}

/// Writes a file that is not there yet, whole or not at all; `mode` as on unix.
fn write_new(path: &Path, text: &str, mode: u32) -> Result<(), KeyError> {
    let fail = |error| KeyError::Write { path: path.to_owned(), error };
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        return Err(fail(io::Error::other("there is no such folder")));
    }
    let mut builder = tempfile::Builder::new();
    builder.prefix(".trainer-");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(mode));
    }
    #[cfg(not(unix))]
    let _ = mode;
    let mut file = builder.tempfile_in(folder).map_err(fail)?;
    file.write_all(text.as_bytes()).map_err(fail)?;
    file.persist_noclobber(path).map_err(|error| match error.error.kind() {
        io::ErrorKind::AlreadyExists => KeyError::Exists(path.to_owned()),
        _ => fail(error.error),
    })?;
    Ok(())
}

/// The line that makes a firmware trust a key.
///
/// ```
/// use firmware_core::update::PublicKey;
/// let line = trainer::signing::rust_line(&PublicKey([0xAB; 32]));
/// assert!(line.starts_with("PublicKey([0xab, 0xab, ") && line.ends_with(", 0xab])"));
/// ```
pub fn rust_line(key: &PublicKey) -> String {
    let bytes: Vec<String> = key.0.iter().map(|byte| format!("{byte:#04x}")).collect();
    format!("PublicKey([{}])", bytes.join(", "))
}

/// Why a file does not allow to install a model.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SignedReleaseError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {error}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// The file is not the TOML that `trainer sign` writes.
    #[error("{}:{line}:{column}: {message}; `trainer sign` writes such files", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// What is wrong there.
        message: String,
    },
    /// The file is one of another version.
    #[error(
        "{}: format {found}; this program reads format {FORMAT}: sign the model again", path.display()
    )]
    Format {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
    /// A hash, key or signature is none.
    #[error(
        "{}: {field}: expected {digits} hexadecimal digits; sign the model again", path.display()
    )]
    Digits {
        /// The file.
        path: PathBuf,
        /// Which.
        field: &'static str,
        /// How long it is.
        digits: usize,
    },
    /// It belongs to another model.
    #[error(
        "{}: signs a model whose {field} is {found}, not {expected}: it belongs to another model; \
         sign this one with `trainer sign`", path.display()
    )]
    AnotherModel {
        /// The file.
        path: PathBuf,
        /// What is not the same.
        field: &'static str,
        /// That of the model.
        expected: String,
        /// That in the file.
        found: String,
    },
    /// A signature is not one of the key.
    #[error(
        "{}: the signature to {purpose} the model is not one of the public key beside it: the file was \
         changed; sign the model again", path.display()
    )]
    Signature {
        /// The file.
        path: PathBuf,
        /// What it should allow.
        purpose: &'static str,
    },
}

/// A release, and the signatures that allow to install it.
///
/// ```
/// use firmware_core::update::Purpose;
/// use std::path::Path;
/// use trainer::signing::{SecretKey, SignedRelease};
///
/// let key = SecretKey::from_seed([7; 32]).unwrap();
/// let signed = SignedRelease::new(&key, "rosbot", 5, b"a blob").unwrap();
/// let text = signed.text();
/// assert!(text.contains("sequence = 5\nlength = 6\n"));
/// let path = Path::new("model.sig");
/// assert_eq!(SignedRelease::parse(&text, path, "rosbot", b"a blob").unwrap(), signed);
/// let other = SignedRelease::parse(&text, path, "rosbot", b"a blot").unwrap_err();
/// assert!(other.to_string().starts_with("model.sig: signs a model whose SHA-256 is "));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SignedRelease {
    /// Name of the robot.
    pub robot: String,
    /// What is signed.
    pub release: Release,
    /// Whose signatures they are.
    pub key: PublicKey,
    /// In the order of [`Purpose::ALL`].
    pub signatures: [[u8; SIGNATURE]; 4],
}

/// The file, version 1.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: u32,
    robot: String,
    sequence: u32,
    length: u32,
    sha256: String,
    public_key: String,
    signatures: Signatures,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Signatures {
    install: String,
    activate: String,
    confirm: String,
    abort: String,
}

impl SignedRelease {
    /// Signs the blob of a robot as release number `sequence`; `None` of a blob of 4 GB and more.
    pub fn new(key: &SecretKey, robot: &str, sequence: u32, blob: &[u8]) -> Option<Self> {
        let release = Release::new(robot, sequence, blob)?;
        let signatures = Purpose::ALL.map(|purpose| key.sign(&statement(purpose, &release)));
        Some(Self { robot: robot.to_owned(), release, key: key.public(), signatures })
    }

    /// The text of its file.
    pub fn text(&self) -> String {
        let Self { robot, release, key, signatures } = self;
        let [install, activate, confirm, abort] = signatures.map(|bytes| hexadecimal(&bytes));
        let file = File {
            format: FORMAT,
            robot: robot.clone(),
            sequence: release.sequence,
            length: release.length,
            sha256: hexadecimal(&release.sha256),
            public_key: hexadecimal(&key.0),
            signatures: Signatures { install, activate, confirm, abort },
        };
        // Numbers and texts alone: TOML has a form for all of them.
        let text = toml::to_string(&file).unwrap_or_default();
        format!(
            "# A model that may be installed: `trainer flash` looks for this file beside it.\n{text}"
        )
    }

    /// Reads the file at `path`, and checks that it belongs to this blob of a robot.
    ///
    /// # Errors
    /// [`SignedReleaseError`].
    pub fn read(path: &Path, robot: &str, blob: &[u8]) -> Result<Self, SignedReleaseError> {
        let bytes = std::fs::read(path)
            .map_err(|error| SignedReleaseError::Read { path: path.to_owned(), error })?;
        Self::parse(&String::from_utf8_lossy(&bytes), path, robot, blob)
    }

    /// The same with the text of the file; `path` is for messages.
    ///
    /// # Errors
    /// [`SignedReleaseError`].
    pub fn parse(
        text: &str,
        path: &Path,
        robot: &str,
        blob: &[u8],
    ) -> Result<Self, SignedReleaseError> {
        let path = || path.to_owned();
        let file: File = toml::from_str(text).map_err(|error| {
            let (line, column) = line_and_column(text, &error);
            let message = error.message().trim().replace('\n', " ");
            SignedReleaseError::Syntax { path: path(), line, column, message }
        })?;
        if file.format != FORMAT {
            return Err(SignedReleaseError::Format { path: path(), found: file.format });
        }
        let digits = |field, digits| SignedReleaseError::Digits { path: path(), field, digits };
        let key = |text: &str, field| from_hexadecimal(text).ok_or_else(|| digits(field, 2 * KEY));
        let signature = |text: &str, purpose| {
            from_hexadecimal(text).ok_or_else(|| digits(verb(purpose), 2 * SIGNATURE))
        };
        let Signatures { install, activate, confirm, abort } = &file.signatures;
        let signed = Self {
            release: Release {
                length: file.length,
                sha256: key(&file.sha256, "sha256")?,
                sequence: file.sequence,
                robot: self::robot(&file.robot),
            },
            key: PublicKey(key(&file.public_key, "public_key")?),
            signatures: [
                signature(install, Purpose::Install)?,
                signature(activate, Purpose::Activate)?,
                signature(confirm, Purpose::Confirm)?,
                signature(abort, Purpose::Abort)?,
            ],
            robot: file.robot,
        };

        let found = [
            ("robot", robot.to_owned(), signed.robot.clone()),
            ("length", blob.len().to_string(), signed.release.length.to_string()),
            ("SHA-256", hexadecimal(&sha256(blob)), hexadecimal(&signed.release.sha256)),
        ];
        if let Some((field, expected, found)) = found.into_iter().find(|(_, a, b)| a != b) {
            return Err(SignedReleaseError::AnotherModel { path: path(), field, expected, found });
        }
        for (purpose, signature) in Purpose::ALL.into_iter().zip(&signed.signatures) {
            if !signed.key.accepts(&statement(purpose, &signed.release), signature) {
                let purpose = verb(purpose);
                return Err(SignedReleaseError::Signature { path: path(), purpose });
            }
        }
        Ok(signed)
    }

    /// The signature for a purpose, as it goes over the line.
    pub fn signature(&self, purpose: Purpose) -> Signature {
        let own = Purpose::ALL.into_iter().zip(&self.signatures).find(|(p, _)| *p == purpose);
        own.map(|(_, bytes)| bytes.iter().copied().collect()).unwrap_or_default()
    }
}

fn verb(purpose: Purpose) -> &'static str {
    match purpose {
        Purpose::Install => "install",
        Purpose::Activate => "activate",
        Purpose::Confirm => "confirm",
        Purpose::Abort => "abort",
    }
}

/// Exactly `N` bytes, two digits each.
fn from_hexadecimal<const N: usize>(text: &str) -> Option<[u8; N]> {
    let digits: Option<Vec<u8>> =
        text.chars().map(|c| c.to_digit(16).map(|digit| digit as u8)).collect();
    let digits = digits.filter(|digits| digits.len() == 2 * N)?;
    let (pairs, _) = digits.as_chunks::<2>();
    let bytes: Vec<u8> = pairs.iter().map(|[high, low]| high << 4 | low).collect();
    bytes.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes<const N: usize>(text: &str) -> [u8; N] {
        from_hexadecimal(text).unwrap()
    }

    /// RFC 8032, section 7.1: secret key, public key, message, signature.
    const VECTORS: [[&str; 4]; 2] = [
        [
            "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
            "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
            "",
            "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701cf9b46b\
             d25bf5f0595bbe24655141438e7a100b",
        ],
        [
            "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb",
            "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
            "72",
            "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e458f3613d0f11d8c\
             387b2eaeb4302aeeb00d291612bb0c00",
        ],
    ];

    #[test]
    fn keys_and_signatures_are_those_of_rfc_8032() {
        let folder = tempfile::tempdir().unwrap();
        for (i, [secret, public, message, signature]) in VECTORS.into_iter().enumerate() {
            // By the file, as it is used.
            let key = SecretKey::from_seed(bytes(secret)).unwrap();
            let (file, other) = key.write(&folder.path().join(format!("key.{i}"))).unwrap();
            assert!(file.ends_with(format!("key.{i}.key")), "{file:?}");
            assert_eq!(std::fs::read_to_string(&file).unwrap(), format!("secret {secret}\n"));
            assert_eq!(std::fs::read_to_string(&other).unwrap(), format!("{public}\n"));
            let key = SecretKey::read(&file).unwrap();
            assert_eq!(key.public(), PublicKey(bytes(public)));
            let message: Vec<u8> = if message.is_empty() { vec![] } else { vec![0x72] };
            assert_eq!(key.sign(&message), bytes::<64>(signature));
            assert!(!format!("{key:?}").contains(&secret[..8]));
            #[cfg(unix)]
            {
                use std::os::unix::fs::PermissionsExt;
                assert_eq!(file.metadata().unwrap().permissions().mode() & 0o777, 0o600);
            }
        }
    }

    #[test]
    fn keys_differ_and_are_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let name = folder.path().join("mine");
        let (one, two) = (SecretKey::generate().unwrap(), SecretKey::generate().unwrap());
        assert_ne!(one.public(), two.public());
        let (secret, public) = one.write(&name).unwrap();
        let before = std::fs::read(&secret).unwrap();
        assert!(matches!(two.write(&name), Err(KeyError::Exists(path)) if path == secret));
        std::fs::remove_file(&secret).unwrap();
        assert!(matches!(two.write(&name), Err(KeyError::Exists(path)) if path == public));
        // Neither is left alone.
        assert!(!secret.exists());
        std::fs::write(&secret, before).unwrap();
        assert_eq!(SecretKey::read(&secret).unwrap().public(), one.public());

        assert!(matches!(SecretKey::read(&public), Err(KeyError::Public(_))));
        let zeros = format!("secret {}", "0".repeat(64));
        for text in ["", "secret", "secret 12", zeros.as_str(), "\u{fffd}\u{0}"] {
            std::fs::write(&secret, text).unwrap();
            assert!(matches!(SecretKey::read(&secret), Err(KeyError::Form(_))), "{text}");
        }
        std::fs::write(&secret, [0xFF; 80]).unwrap();
        assert!(matches!(SecretKey::read(&secret), Err(KeyError::Form(_))));
        assert!(matches!(SecretKey::read(&name), Err(KeyError::Read { .. })));
        let nowhere = folder.path().join("no/mine");
        assert!(matches!(one.write(&nowhere), Err(KeyError::Write { .. })));
    }

    #[test]
    fn the_same_release_has_the_same_text() {
        let key = SecretKey::from_seed(bytes(VECTORS[0][0])).unwrap();
        let signed = || SignedRelease::new(&key, "rosbot", 7, b"blob").unwrap();
        assert_eq!(signed().text(), signed().text());
        // The controller's own check, and each signature for one purpose alone.
        let release = Release::new("rosbot", 7, b"blob").unwrap();
        for (i, purpose) in Purpose::ALL.into_iter().enumerate() {
            for (j, of) in Purpose::ALL.into_iter().enumerate() {
                let accepted =
                    key.public().accepts(&statement(purpose, &release), &signed().signature(of));
                assert_eq!(accepted, i == j);
            }
        }
    }

    #[test]
    fn every_change_to_the_file_is_noticed() {
        let key = SecretKey::from_seed(bytes(VECTORS[0][0])).unwrap();
        let text = SignedRelease::new(&key, "rosbot", 7, b"blob").unwrap().text();
        let path = Path::new("m.sig");
        let read = |text: &str| SignedRelease::parse(text, path, "rosbot", b"blob");
        read(&text).unwrap();
        let changed = |from: &str, to: &str, expected: &[&str]| {
            assert!(text.contains(from), "{from}");
            let message = read(&text.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(message.starts_with("m.sig:"), "{message}");
            assert!(expected.iter().all(|part| message.contains(part)), "{message}");
        };
        changed(
            "format = 1",
            "format = 2",
            &["format 2", "reads format 1", "sign the model again"],
        );
        changed("sequence = 7", "sequence = 8", &["to install", "was changed", "sign"]);
        changed("sequence = 7", "sequence = -1", &["m.sig:4:12: "]);
        changed("sequence", "number", &["unknown field `number`", "`trainer sign`"]);
        changed("length = 4", "length = 5", &["length is 5, not 4", "sign this one"]);
        changed("robot = \"rosbot\"", "robot = \"leg\"", &["robot is leg, not rosbot"]);
        changed("sha256 = \"", "sha256 = \"0", &["sha256: expected 64 hexadecimal digits"]);
        changed("abort = \"", "abort = \"é", &["abort: expected 128 hexadecimal digits"]);
        for (line, start) in [(5, "sha256 = "), (6, "public_key = "), (9, "install = ")] {
            let found = text.lines().nth(line).unwrap();
            assert!(found.starts_with(start), "{found}");
        }
        // Another digit, anywhere in a hash, key or signature.
        for (at, digit) in text.char_indices().filter(|(at, _)| *at > text.find("sha256").unwrap())
        {
            let inside = text[..at].matches('"').count() % 2 == 1 && digit != '"';
            if inside {
                let other = if digit == '0' { "1" } else { "0" };
                let mut text = text.clone();
                text.replace_range(at..=at, other);
                assert!(read(&text).is_err(), "{at}");
            }
        }
        let swapped = text.replace("install", "x").replace("activate", "install");
        assert!(read(&swapped.replace("x = ", "activate = ")).is_err());
        assert!(read("").unwrap_err().to_string().contains("missing field `format`"));
    }
}
