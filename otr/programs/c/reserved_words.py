"""Names that a function in C cannot have."""

from __future__ import annotations

import re

# Of C99 to C23, and of C++, which may include the file.
_KEYWORDS = """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl concept const const_cast
    consteval constexpr constinit continue co_await co_return co_yield decltype default delete do double dynamic_cast
    else enum explicit export extern false float for friend goto if inline int long main mutable namespace new noexcept
    not not_eq nullptr operator or or_eq private protected public register reinterpret_cast requires restrict return
    short signed sizeof static static_assert static_cast struct switch template this thread_local throw true try typedef
    typeid typename typeof typeof_unqual union unsigned using virtual void volatile wchar_t while xor xor_eq
"""
# Functions of the standard library that compilers know without a header; those of numbers also end in f and l.
_OF_NUMBERS = """
    acos acosh asin asinh atan atan2 atanh cabs cacos cacosh carg casin casinh catan catanh cbrt ccos ccosh ceil cexp
    cimag clog conj copysign cos cosh cpow cproj creal csin csinh csqrt ctan ctanh erf erfc exp exp2 expm1 fabs fdim
    floor fma fmax fmin fmod frexp hypot ilogb ldexp lgamma llrint llround log log10 log1p log2 logb lrint lround modf
    nan nearbyint nextafter nexttoward pow remainder remquo rint round scalbln scalbn sin sinh sqrt tan tanh tgamma
    trunc
"""
_FUNCTIONS = """
    abort abs calloc exit fprintf fputc fputs free fscanf fwrite imaxabs labs llabs malloc memchr memcmp memcpy memmove
    memset printf putc putchar puts realloc scanf snprintf sprintf sscanf strcat strchr strcmp strcpy strcspn strlen
    strncat strncmp strncpy strpbrk strrchr strspn strstr tolower toupper towlower towupper vfprintf vfscanf vprintf
    vscanf vsnprintf vsprintf vsscanf fpclassify isfinite isgreater isgreaterequal isless islessequal islessgreater
    isinf isnan isnormal isunordered signbit
"""
_CLASSES = r"isw?(alnum|alpha|blank|cntrl|digit|graph|lower|print|punct|space|upper|xdigit)"
# Types and macros of stdint.h, math.h and what they include.
_DEFINED = (
    r"u?int\w*_t|float_t|double_t|U?INT\w*_(C|MAX|MIN)|[A-Z]+_(MAX|MIN)|FP_[A-Z]+|HUGE_VAL[FL]?|INFINITY|NAN|M_\w+"
)
_TAKEN = frozenset(f"{_KEYWORDS} {_FUNCTIONS}".split()) | {
    f"{word}{suffix}" for word in _OF_NUMBERS.split() for suffix in ("", "f", "l")
}


def is_function_name(name: str) -> bool:
    """Return whether a policy's function may have this name: ASCII letters, digits, underscores, and not taken."""
    is_identifier = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is not None
    return is_identifier and name not in _TAKEN and re.fullmatch(f"{_CLASSES}|{_DEFINED}", name) is None
