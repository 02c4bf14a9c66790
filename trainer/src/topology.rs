//! From a topology to its lifting functions, as in Table I of Shi & Karydis (2021).

use firmware_core::dictionary::{Basis, Block, Dictionary, Factor, Observable, Source};

use crate::terms::{Form, Names, distinct_terms};

/// Why a topology has no dictionary.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TopologyError {
    /// A factor of the product is not known.
    #[error(
        "`{factor}` is not a space that this program knows: expected R^n, E^n, S^1, S^2 or T^n, \
         joined by `x`, such as \"R^2 x S^1\""
    )]
    Space {
        /// The factor.
        factor: String,
    },
    /// An order names nothing.
    #[error("`{name}` in --order is not one of the variables {}", known.join(", "))]
    Variable {
        /// The name.
        name: String,
        /// What there is.
        known: Vec<String>,
    },
    /// The dictionary is larger than a controller takes.
    #[error("the dictionary is too large for the controller: {0:?}")]
    TooLarge(firmware_core::dictionary::DictionaryError),
}

/// The dictionary of a topology.
#[derive(Clone, Debug, PartialEq)]
pub struct Lifting {
    /// Names of the state coordinates, each with whether it is an angle.
    pub states: Vec<(String, bool)>,
    /// Names of the inputs.
    pub inputs: Vec<String>,
    /// D(x) in the paper's notation.
    pub state_functions: String,
    /// The whole dictionary, kron(D(x), D(u)).
    pub functions: String,
    /// All terms, first factor slowest.
    pub terms: Vec<String>,
}

/// Orders of the variables: a common one and exceptions by name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Orders {
    /// For all others.
    pub common: u8,
    /// For these.
    pub by_name: Vec<(String, u8)>,
}

impl Orders {
    fn of(&self, name: &str) -> u8 {
        self.by_name.iter().find(|(n, _)| n == name).map_or(self.common, |(_, order)| *order)
    }
}

/// A tree of Kronecker products, as the paper writes it.
enum Expression {
    Basis(Source, String, u8),
    Kron(Box<Expression>, Box<Expression>),
}

impl Expression {
    fn kron(parts: impl IntoIterator<Item = Self>) -> Option<Self> {
        parts.into_iter().reduce(|a, b| Self::Kron(Box::new(a), Box::new(b)))
    }

    fn text(&self) -> String {
        match self {
            Self::Basis(_, name, order) => format!("H{order}({name})"),
            Self::Kron(a, b) => format!("kron({},{})", a.text(), b.text()),
        }
    }

    fn factors(&self, out: &mut Vec<(Source, u8)>) {
        match self {
            Self::Basis(source, _, order) => out.push((*source, *order)),
            Self::Kron(a, b) => {
                a.factors(out);
                b.factors(out);
            }
        }
    }
}

/// Builds the dictionary of a topology such as `R^2 x S^1` with some inputs.
///
/// ```
/// use trainer::topology::{Orders, lifting};
/// let orders = Orders { common: 1, by_name: vec![] };
/// let wheeled = lifting("R^2 x S^1", 2, &orders).unwrap();
/// assert_eq!(wheeled.state_functions, "kron(kron(H1(x),H1(y)),kron(H1(sin(theta)),H1(cos(theta))))");
/// assert_eq!(wheeled.terms.len(), 64);
/// assert_eq!(wheeled.terms[1], "u2"); // the first factor, x, is the slowest
/// ```
///
/// # Errors
/// [`TopologyError`].
pub fn lifting(topology: &str, inputs: usize, orders: &Orders) -> Result<Lifting, TopologyError> {
    // Number of real coordinates or angles per factor of the product.
    let mut spaces: Vec<(bool, usize)> = Vec::new();
    for factor in topology.split(['x', 'X', '×', '*']) {
        let unknown = || TopologyError::Space { factor: factor.trim().to_owned() };
        let compact: String = factor.chars().filter(|c| !c.is_whitespace()).collect();
        let mut letters = compact.chars();
        let letter = letters.next().ok_or_else(unknown)?.to_ascii_uppercase();
        let power = letters.as_str().trim_start_matches('^');
        let power: usize =
            if power.is_empty() { 1 } else { power.parse().map_err(|_| unknown())? };
        spaces.push(match (letter, power) {
            ('R' | 'E', 1..=8) => (false, power),
            // The sphere by two angles, as in the paper.
            ('S', 1 | 2) | ('T', 1..=8) => (true, power),
            _ => return Err(unknown()),
        });
    }
    let lines: usize = spaces.iter().filter(|(angle, _)| !angle).map(|(_, n)| n).sum();
    let angles: usize = spaces.iter().filter(|(angle, _)| *angle).map(|(_, n)| n).sum();
    let line_names = |i: usize| match lines {
        1..=3 => ["x", "y", "z"][i].to_owned(),
        _ => format!("x{}", i + 1),
    };
    let angle_names = |i: usize| match angles {
        1 | 2 => ["theta", "phi"][i].to_owned(),
        _ => format!("theta{}", i + 1),
    };
    let input_names: Vec<String> = (1..=inputs).map(|i| format!("u{i}")).collect();

    let mut states: Vec<(String, bool)> = Vec::new();
    let (mut line, mut angle) = (0, 0);
    let mut products = Vec::new();
    for (is_angle, count) in &spaces {
        let mut parts = Vec::new();
        for _ in 0..*count {
            let i = states.len() as u8;
            if *is_angle {
                let name = angle_names(angle);
                angle += 1;
                let order = orders.of(&name);
                let basis =
                    |source, f: &str| Expression::Basis(source, format!("{f}({name})"), order);
                parts.extend(Expression::kron([
                    basis(Source::Sin(i), "sin"),
                    basis(Source::Cos(i), "cos"),
                ]));
                states.push((name, true));
            } else {
                let name = line_names(line);
                line += 1;
                parts.push(Expression::Basis(Source::State(i), name.clone(), orders.of(&name)));
                states.push((name, false));
            }
        }
        products.extend(Expression::kron(parts));
    }
    let known: Vec<String> =
        states.iter().map(|(n, _)| n.clone()).chain(input_names.clone()).collect();
    if let Some((name, _)) = orders.by_name.iter().find(|(n, _)| !known.contains(n)) {
        return Err(TopologyError::Variable { name: name.clone(), known });
    }
    let unknown = TopologyError::Space { factor: topology.to_owned() };
    let state_product = Expression::kron(products).ok_or(unknown)?;
    let state_functions = state_product.text();
    let input_product =
        Expression::kron(input_names.iter().enumerate().map(|(i, name)| {
            Expression::Basis(Source::Input(i as u8), name.clone(), orders.of(name))
        }));
    let whole = match input_product {
        None => state_product,
        Some(inputs) => Expression::Kron(Box::new(state_product), Box::new(inputs)),
    };

    let mut factors = Vec::new();
    whole.factors(&mut factors);
    factors.retain(|(_, order)| *order > 0);
    let observable =
        |(source, _): &(Source, u8)| Observable { source: *source, lag: 0, centre: 0.0, gain: 1.0 };
    let too_large = |capacity| {
        TopologyError::TooLarge(firmware_core::dictionary::DictionaryError::TooLarge {
            field: "factors of a block",
            capacity,
            found: factors.len(),
        })
    };
    let capacity = firmware_core::capacity::MAX_BLOCK_FACTORS;
    if factors.len() > capacity {
        return Err(too_large(capacity));
    }
    let dictionary = Dictionary::new(
        factors.iter().map(observable).collect(),
        factors
            .iter()
            .enumerate()
            .map(|(i, (_, order))| Factor {
                observable: i as u8,
                basis: Basis::Hermite,
                order: *order,
            })
            .collect(),
        [Block { factors: factors.len() as u8, max_degree: 0 }].into_iter().collect(),
    )
    .map_err(TopologyError::TooLarge)?;
    let state_names: Vec<&str> = states.iter().map(|(n, _)| n.as_str()).collect();
    let inputs: Vec<&str> = input_names.iter().map(String::as_str).collect();
    let names = Names { states: &state_names, inputs: &inputs };
    let terms = distinct_terms(&dictionary)
        .into_iter()
        .map(|i| names.term(&dictionary, i, Form::Hermite))
        .collect();
    Ok(Lifting { functions: whole.text(), state_functions, terms, states, inputs: input_names })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Table I of the paper, row by row: topology and D(x).
    #[test]
    fn all_rows_of_the_papers_table() {
        let circles = "kron(kron(H1(sin(theta)),H1(cos(theta))),kron(H1(sin(phi)),H1(cos(phi))))";
        let rows = [
            ("R^1", "H1(x)"),
            ("R^2", "kron(H1(x),H1(y))"),
            ("R^3", "kron(kron(H1(x),H1(y)),H1(z))"),
            ("S^2", circles),
            ("S^1 x S^1", circles),
            ("E^1 x S^1", "kron(H1(x),kron(H1(sin(theta)),H1(cos(theta))))"),
            ("R^2 x S^1", "kron(kron(H1(x),H1(y)),kron(H1(sin(theta)),H1(cos(theta))))"),
        ];
        let orders = Orders { common: 1, by_name: Vec::new() };
        for (topology, expected) in rows {
            let found = lifting(topology, 0, &orders).unwrap();
            assert_eq!(found.functions, expected, "{topology}");
            assert_eq!(found.terms.len(), 1 << expected.matches("H1").count(), "{topology}");
        }
        assert_eq!(lifting("T^2", 0, &orders).unwrap().functions, circles);
        let terms = lifting("R x S", 1, &orders).unwrap().terms;
        assert_eq!(terms[..5], ["1", "u1", "cos(theta)", "cos(theta)*u1", "sin(theta)"]);
        assert_eq!(terms[15], "x*sin(theta)*cos(theta)*u1");
    }

    #[test]
    fn orders_and_unknown_spaces() {
        let orders = Orders { common: 1, by_name: vec![("u1".into(), 3)] };
        let lifted = lifting("R", 1, &orders).unwrap();
        assert_eq!(lifted.functions, "kron(H1(x),H3(u1))");
        assert_eq!(lifted.terms[2..4], ["H2(u1)", "H3(u1)"]);
        for bad in ["Q^2", "", "R^0", "S^3", "R^2 y"] {
            assert!(matches!(lifting(bad, 0, &orders), Err(TopologyError::Space { .. })), "{bad}");
        }
        let orders = Orders { common: 1, by_name: vec![("w".into(), 3)] };
        assert!(matches!(lifting("R", 0, &orders), Err(TopologyError::Variable { .. })));
        let orders = Orders { common: 9, by_name: vec![] };
        assert!(matches!(lifting("R^8", 2, &orders), Err(TopologyError::TooLarge(_))));
    }
}
