//! Enums whose variants are words in a scenario file, and the macro that declares them. The scenario hash covers the
//! words, and doc comments appear in `docs/scenario.md`, which a test compares. `tests/fuzz/scenario.dict` lists every
//! word, which another test compares (`bs/src/scenario/tests/pages.rs`).

/// A word that a field may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Alternative {
    /// The word.
    pub name: &'static str,
    /// Its meaning, in one or two sentences.
    pub about: &'static str,
}

/// A closed set of words. [`crate::choices!`] implements it.
pub trait ChoiceType: Copy + Eq + Sized + 'static {
    /// All variants in the order of declaration. Pages show words in this order.
    const ALL: &'static [Self];
    /// The words of the variants, in the same order.
    const ALTERNATIVES: &'static [Alternative];

    /// Returns the variant with the word `name`.
    fn from_name(name: &str) -> Option<Self> {
        let index = Self::ALTERNATIVES.iter().position(|known| known.name == name)?;
        Self::ALL.get(index).copied()
    }
}

/// Declares an enum whose variants are words of a scenario file. Help and reference show their doc comments.
///
/// The wire format encodes an enum that also derives `Serialize` by the position of its variants.
///
/// The enum gets `name()`, `about()` and the traits [`ChoiceType`] and [`FieldRepr`](super::FieldRepr).
#[macro_export]
macro_rules! choices {
    (
        $(#[$meta:meta])*
        $vis:vis enum $type:ident {
            $( $(#[doc = $about:literal])+ $variant:ident = $name:literal ),+ $(,)?
        }
    ) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        $vis enum $type {
            $( $(#[doc = $about])+ $variant ),+
        }

        impl $type {
            /// The word of the variant in scenario files.
            pub const fn name(self) -> &'static str {
                match self { $( Self::$variant => $name ),+ }
            }

            /// The meaning of the variant.
            pub const fn about(self) -> &'static str {
                match self { $( Self::$variant => concat!($($about),+).trim_ascii() ),+ }
            }
        }

        impl $crate::declare::ChoiceType for $type {
            const ALL: &'static [Self] = &[$( Self::$variant ),+];
            const ALTERNATIVES: &'static [$crate::declare::Alternative] = &[$(
                $crate::declare::Alternative { name: $name, about: Self::$variant.about() }
            ),+];
        }

        impl $crate::declare::FieldRepr for $type {
            fn from_value(value: $crate::declare::FieldValue<'_>) -> Option<Self> {
                if let $crate::declare::FieldValue::Text(name) = value {
                    <Self as $crate::declare::ChoiceType>::from_name(name)
                } else {
                    None
                }
            }

            fn value(&self) -> Option<$crate::declare::FieldValue<'_>> {
                Some($crate::declare::FieldValue::Text(self.name()))
            }
        }
    };
}

pub use choices;
