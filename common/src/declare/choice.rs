//! Enums whose variants are words of a file.

/// One of the words that a field may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Alternative {
    /// The word.
    pub name: &'static str,
    /// What it stands for, a sentence or two.
    pub about: &'static str,
}

/// A closed set of words. [`crate::choices!`] makes one.
pub trait Choice: Copy + Eq + Sized + 'static {
    /// All variants in the order of declaration.
    const ALL: &'static [Self];
    /// Their words, in the same order.
    const ALTERNATIVES: &'static [Alternative];

    /// The variant that `name` stands for.
    fn named(name: &str) -> Option<Self> {
        let at = Self::ALTERNATIVES.iter().position(|known| known.name == name)?;
        Self::ALL.get(at).copied()
    }
}

/// Declares an enum whose variants are words of a scenario file: the doc comments are what help and reference say of
/// them.
///
/// It gets `name()`, `about()` and the traits [`Choice`] and [`Declared`](super::Declared).
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
            /// Its word in scenario files.
            pub const fn name(self) -> &'static str {
                match self { $( Self::$variant => $name ),+ }
            }

            /// What it stands for.
            pub const fn about(self) -> &'static str {
                match self { $( Self::$variant => concat!($($about),+).trim_ascii() ),+ }
            }
        }

        impl $crate::declare::Choice for $type {
            const ALL: &'static [Self] = &[$( Self::$variant ),+];
            const ALTERNATIVES: &'static [$crate::declare::Alternative] = &[$(
                $crate::declare::Alternative { name: $name, about: Self::$variant.about() }
            ),+];
        }

        impl $crate::declare::Declared for $type {
            fn from_value(value: $crate::declare::Value<'_>) -> Option<Self> {
                if let $crate::declare::Value::Text(name) = value {
                    <Self as $crate::declare::Choice>::named(name)
                } else {
                    None
                }
            }

            fn value(&self) -> Option<$crate::declare::Value<'_>> {
                Some($crate::declare::Value::Text(self.name()))
            }
        }
    };
}

pub use choices;
