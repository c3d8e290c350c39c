//! Several numbers side by side that one instruction works on.
//!
//! The compiler makes vector instructions of plain loops over arrays where it sees them; in the
//! walk of a lone ray it does not. [`Plain`] is the portable way; on x86-64 the registers of the
//! machine do the same, bit by bit: every operation is rounded by itself.

/// `N` numbers of which each operation treats every one alike.
pub(super) trait Lanes<const N: usize>: Copy {
    fn load(numbers: &[f32; N]) -> Self;
    fn splat(number: f32) -> Self;
    fn to_array(self) -> [f32; N];
    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
    fn times(self, other: Self) -> Self;
    fn over(self, other: Self) -> Self;
    /// The smaller one; `other` where either is no number.
    fn or_less(self, other: Self) -> Self;
    /// The larger one; `other` where either is no number.
    fn or_more(self, other: Self) -> Self;
    fn magnitude(self) -> Self;
    /// A bit per lane, the first the lowest: where this is not more than the other.
    fn at_most(self, other: Self) -> u32;
}

/// An array.
#[derive(Clone, Copy)]
pub(super) struct Plain<const N: usize>([f32; N]);

impl<const N: usize> Plain<N> {
    #[inline(always)]
    fn with(self, other: Self, operation: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| {
            operation(self.0[lane], other.0[lane])
        }))
    }
}

impl<const N: usize> Lanes<N> for Plain<N> {
    #[inline(always)]
    fn load(numbers: &[f32; N]) -> Self {
        Self(*numbers)
    }
    #[inline(always)]
    fn splat(number: f32) -> Self {
        Self([number; N])
    }
    #[inline(always)]
    fn to_array(self) -> [f32; N] {
        self.0
    }
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }
    #[inline(always)]
    fn minus(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }
    #[inline(always)]
    fn times(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }
    #[inline(always)]
    fn over(self, other: Self) -> Self {
        self.with(other, |a, b| a / b)
    }
    #[inline(always)]
    fn or_less(self, other: Self) -> Self {
        self.with(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn or_more(self, other: Self) -> Self {
        self.with(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn magnitude(self) -> Self {
        Self(self.0.map(f32::abs))
    }
    #[inline(always)]
    fn at_most(self, other: Self) -> u32 {
        let bit = |lane: usize| u32::from(self.0[lane] <= other.0[lane]) << lane;
        (0..N).fold(0, |bits, lane| bits | bit(lane))
    }
}

/// The registers of x86-64. They are only made by code that is compiled for AVX2 and called where
/// the machine has it (`Scene::cast_lone`), so the instructions exist.
#[cfg(target_arch = "x86_64")]
mod x86 {
    #![expect(
        unsafe_code,
        reason = "methods of traits cannot be compiled for an instruction set; they become part of callers that are"
    )]
    use std::arch::x86_64::*;

    use super::Lanes;

    macro_rules! lanes {
        ($register:ty, $count:literal, $splat:ident, $plus:ident, $minus:ident, $times:ident,
         $over:ident, $less:ident, $more:ident, $and_not:ident, $at_most:expr) => {
            impl Lanes<$count> for $register {
                #[inline(always)]
                fn load(numbers: &[f32; $count]) -> Self {
                    bytemuck::cast(*numbers)
                }
                #[inline(always)]
                fn splat(number: f32) -> Self {
                    unsafe { $splat(number) }
                }
                #[inline(always)]
                fn to_array(self) -> [f32; $count] {
                    bytemuck::cast(self)
                }
                #[inline(always)]
                fn plus(self, other: Self) -> Self {
                    unsafe { $plus(self, other) }
                }
                #[inline(always)]
                fn minus(self, other: Self) -> Self {
                    unsafe { $minus(self, other) }
                }
                #[inline(always)]
                fn times(self, other: Self) -> Self {
                    unsafe { $times(self, other) }
                }
                #[inline(always)]
                fn over(self, other: Self) -> Self {
                    unsafe { $over(self, other) }
                }
                #[inline(always)]
                fn or_less(self, other: Self) -> Self {
                    unsafe { $less(self, other) }
                }
                #[inline(always)]
                fn or_more(self, other: Self) -> Self {
                    unsafe { $more(self, other) }
                }
                #[inline(always)]
                fn magnitude(self) -> Self {
                    unsafe { $and_not($splat(-0.0), self) }
                }
                #[inline(always)]
                fn at_most(self, other: Self) -> u32 {
                    unsafe { $at_most(self, other) }
                }
            }
        };
    }

    lanes!(
        __m256,
        8,
        _mm256_set1_ps,
        _mm256_add_ps,
        _mm256_sub_ps,
        _mm256_mul_ps,
        _mm256_div_ps,
        _mm256_min_ps,
        _mm256_max_ps,
        _mm256_andnot_ps,
        at_most_of_8
    );
    lanes!(
        __m128,
        4,
        _mm_set1_ps,
        _mm_add_ps,
        _mm_sub_ps,
        _mm_mul_ps,
        _mm_div_ps,
        _mm_min_ps,
        _mm_max_ps,
        _mm_andnot_ps,
        at_most_of_4
    );

    #[inline(always)]
    unsafe fn at_most_of_8(a: __m256, b: __m256) -> u32 {
        unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(a, b)) as u32 }
    }

    #[inline(always)]
    unsafe fn at_most_of_4(a: __m128, b: __m128) -> u32 {
        unsafe { _mm_movemask_ps(_mm_cmple_ps(a, b)) as u32 }
    }
}
