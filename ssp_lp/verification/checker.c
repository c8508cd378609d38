/* Check a certificate by exact inequalities, a million actions within a minute.
 *
 *     cc -O2 -o check checker.c -lgmp -lz && ./check FILE
 *
 * It prints an interval that holds the optimum, and answers 0; or which inequality fails where, and
 * answers 1; or it cannot work, and answers 2. It shares nothing with the library, nor with
 * checker.py beside it, which reads the same files; docs/guides/certificate.md says more of them.
 *
 * The question. A run ends in the goal; or in a dead-end, from which no way leads to the goal; or
 * it is given up; or it wanders for ever. A quantity has weights >= 0 for expected costs, for
 * arrivals in states, for arrivals in ends, and for the two last cases ("stop"). An end of weight
 * -a < 0 counts as -a, and a for each other end. A row is quantity <= bound. With a discount the
 * share 1 - discount of each step comes to one more dead-end, which has the number n.
 *
 * The proof. Each column of numbers y in the file bounds a quantity of its own from below:
 *
 *     y(x) <= own(x, u) + sum p(x') (arrival(x') + y(x')),  or y(x) <= own(x) + stop on stopping,
 *
 * so that none of those to whom its inequalities apply takes less than y at the start:
 *   v       the objective and, at prices >= 0, the rows. It is asked of all actions and stops; a
 *           lottery within the rows wanders by actions alone that take nothing of any quantity, as
 *           it would take infinitely much of one otherwise. Where no failure is allowed, it is
 *           asked of what keeps the goal sure;
 *   w       failure, if a share of the greatest goal probability is asked for;
 *   -t, -u  of a member of the lottery: minus its steps, which shows that it ends, and minus the
 *           objective and each row, which it takes at most u of. They are asked of its decisions.
 *
 * Numbers of the proof, and arrivals, are rounded down to units of 10^-60. All else is exact. The
 * model is read three times, a line at a time: for its graph, for the charges of dead-ends, and for
 * the inequalities; the proof once. Its SHA-256 ties the readings together.
 */
#include <ctype.h>
#include <gmp.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zlib.h>

enum { DIGITS = 60, LONGEST = 4000, NONE = -1, STOP = -2 };
enum kind { VISITS, END, OTHER_END };

struct term { mpq_t weight; enum kind kind; bool *states; };
struct quantity {
    char *name;
    mpq_t constant, stop, bound, *costs;
    struct term *terms;
    size_t size;
};
struct column {
    char name[100];
    mpq_t *share, *costs, stop;  /* of each quantity in it; and so its weights */
    bool steps;                  /* whether it counts -1 for each step */
    int32_t *decision;           /* of the member in each state */
    mpz_t *after;                /* arrival + y of each state, in units */
};
struct pair { uint32_t home; bool costless, stays, keeps; };  /* a state and an action */
struct outcome { uint32_t pair, state, other; };  /* and another one that comes to the state */

static gzFile file;
static char *line, *at;  /* the line that is read, and its part that is not read yet */
static uint32_t hash[8], k[64];
static unsigned char block[64];
static uint64_t hashed;
static size_t n_lines, n_sets, n_start, n_rows, n_members, n_columns, n_pairs, n_outcomes, told;
static long n, n_costs, *start_state;
static char **sets, *asked, digest[65];
static mpq_t claimed[2], one, a, b, c, left, right, discount, share, *start_part, *prices, *weights;
static mpz_t units, z;
static long state, *next;             /* what is read: a state and an action, that lead to others */
static char *state_name, *action;     /* with parts of a sum; means of the costs, times the sum; */
static mpq_t *part, sum, *paid, *least_paid;              /* and the least ones of the state */
static bool **in_set, *goal, *dead, *live, *giving_up, *wandering, *roaming, *sure;
static bool anywhere, attention, charging, greatest, least, sharing, budgeted, may_fail;
static struct quantity *quantities;  /* the objective, and the rows */
static struct column *columns;       /* v, w; then of each member -t, and -u of each quantity */
static struct pair *pairs;
static struct outcome *outcomes;
static size_t *first_pair;           /* of each state */
static uint32_t *coming;             /* 1 + an outcome that comes to each state, or 0 */

static _Noreturn void refuse(const char *format, ...) {
    va_list words;
    va_start(words, format);
    printf(at && *at ? "refused: line %zu: " : "refused: ", n_lines);
    vprintf(format, words);
    printf("\n");
    exit(1);
}

static _Noreturn void fail(const char *words) {
    fprintf(stderr, "%s\n", words);
    exit(2);
}

/* Array of another length; one entry more is always there. */
static void *resized(void *array, size_t count, size_t size) {
    array = count < SIZE_MAX / size - 1 ? realloc(array, (count + 1) * size) : NULL;
    if (!array) fail("there is not enough memory");
    return array;
}

/* Array with room for one more entry: its room is doubled when it is full. */
static void *grown(void *array, size_t count, size_t size) {
    return count & (count - 1) ? array : resized(array, 2 * count, size);
}

static void *zeros(size_t count, size_t size) {
    void *array = calloc(count + 1, size);
    if (!array) fail("there is not enough memory");
    return array;
}

static mpq_t *rationals(size_t count) {
    mpq_t *array = resized(NULL, count, sizeof *array);
    for (size_t i = 0; i <= count; i++) mpq_init(array[i]);
    return array;
}

static void add_product(mpq_t total, const mpq_t one_factor, const mpq_t other_factor) {
    if (!mpq_sgn(one_factor) || !mpq_sgn(other_factor)) return;
    mpq_mul(c, one_factor, other_factor);
    mpq_add(total, total, c);
}

/* ---- SHA-256 (FIPS 180-4), whose constants are digits of roots of primes ---- */

static void take_roots(uint32_t *digits, int count, unsigned long degree) {
    for (unsigned long prime = 2; count; prime++) {
        mpz_set_ui(z, prime);
        if (!mpz_probab_prime_p(z, 25)) continue;
        mpz_mul_2exp(z, z, 32 * degree);
        mpz_root(z, z, degree);
        *digits++ = (uint32_t)mpz_get_ui(z);
        count--;
    }
}

static uint32_t turned(uint32_t x, int by) { return x >> by | x << (32 - by); }

static void hash_block(void) {
    uint32_t w[64] = {0}, s[8];
    for (int i = 0; i < 64; i++) w[i / 4] = w[i / 4] << 8 | block[i];
    for (int i = 16; i < 64; i++)
        w[i] = w[i - 16] + (turned(w[i - 15], 7) ^ turned(w[i - 15], 18) ^ w[i - 15] >> 3)
             + w[i - 7] + (turned(w[i - 2], 17) ^ turned(w[i - 2], 19) ^ w[i - 2] >> 10);
    memcpy(s, hash, sizeof s);
    for (int i = 0; i < 64; i++) {
        uint32_t t = s[7] + (turned(s[4], 6) ^ turned(s[4], 11) ^ turned(s[4], 25))
                   + (s[6] ^ (s[4] & (s[5] ^ s[6]))) + k[i] + w[i];
        uint32_t u = (turned(s[0], 2) ^ turned(s[0], 13) ^ turned(s[0], 22))
                   + ((s[0] & s[1]) | (s[2] & (s[0] | s[1])));
        memmove(s + 1, s, 7 * sizeof *s);
        s[4] += t;
        s[0] = t + u;
    }
    for (int i = 0; i < 8; i++) hash[i] += s[i];
}

static void hash_bytes(const char *bytes, size_t length) {
    while (length--) {
        block[hashed++ % 64] = (unsigned char)*bytes++;
        if (hashed % 64 == 0) hash_block();
    }
}

static void end_hash(char *digits) {
    char length[8];
    for (int i = 0; i < 8; i++) length[i] = (char)(8 * hashed >> (56 - 8 * i));
    hash_bytes("\x80", 1);
    while (hashed % 64 != 56) hash_bytes("", 1);
    hash_bytes(length, 8);
    for (int i = 0; i < 8; i++) sprintf(digits + 8 * i, "%08x", (unsigned)hash[i]);
}

/* ---- Reading lines of JSON, their keys in the order in which they are written ---- */

static bool next_line(void) {
    static size_t room = 0;
    size_t length = 0;
    int byte, error;
    at = NULL;
    while ((byte = gzgetc(file)) != -1 && byte != '\n') {
        if (byte < ' ' || byte > '~') refuse("line %zu is no printable ASCII", n_lines + 1);
        if (length > INT32_MAX) refuse("line %zu is too long", n_lines + 1);
        if (length == room) line = resized(line, room = 2 * room + 100, 1);
        line[length++] = (char)byte;
    }
    if (byte == -1 && (gzerror(file, &error), error != Z_OK)) refuse("the gzip file is damaged");
    if (byte == -1 && !length) return false;
    if (!length) refuse("line %zu is empty", n_lines + 1);
    line[length] = 0;
    at = line;
    if (n_lines++) hash_bytes("\n", 1);
    hash_bytes(line, length);
    return true;
}

static bool take(const char *word) {
    while (*at == ' ') at++;
    bool found = !strncmp(at, word, strlen(word));
    if (found) at += strlen(word);
    return found;
}

/* A string. Each has one way to be written, so that it may be compared as it is written. */
static char *string(void) {
    if (!take("\"")) refuse("\"%.40s\" is no text", at);
    char *text = at;
    for (; *at != '"'; at++) {
        if (!*at) refuse("a text does not end");
        if (*at != '\\' || (*++at && strchr("\"\\bfnrt", *at))) continue;
        bool four = *at == 'u' && strspn(at + 1, "0123456789abcdef") >= 4;
        if (!four || strncmp(at, "u007f", 5) < 0) refuse("a letter is escaped that is not to be");
    }
    *at++ = 0;
    return text;
}

static char *kept(const char *text) {
    return strcpy(zeros(strlen(text), 1), text);
}

static bool truth(void) {
    bool value = take("true");
    if (!value && !take("false")) refuse("\"%.40s\" is neither true nor false", at);
    return value;
}

static long whole(long below) {
    char *end = at;
    long value = !take(" ") && isdigit(*at) ? strtol(at, &end, 10) : below;
    if (value >= below || (*at == '0' && end > at + 1))
        refuse("\"%.20s\" is no whole number below %ld", at, below);
    at = end;
    return value;
}

/* Digits at a place, of which there are some, are put behind others; what follows them. */
static const char *take_digits(const char *s, char *digits) {
    size_t size = strspn(s, "0123456789");
    if (!size) refuse("no number ends in \"%.40s\"", s);
    strncat(digits, s, size);
    return s + size;
}

/* A decimal or a fraction, not in lowest terms. */
static void number(mpq_t q) {
    static char digits[LONGEST], more[LONGEST];
    const char *s = string(), *point;
    long power = 0;
    if (strlen(s) >= LONGEST) refuse("a number is too long");
    strcpy(digits, *s == '-' ? "-" : "");
    s = take_digits(s + (*s == '-'), digits);
    strcpy(more, "");
    mpz_set_ui(z, 1);
    if (*s == '/') {
        s = take_digits(s + 1, more);
        mpz_set_str(z, more, 10);
    } else {
        if (*(point = s) == '.') power = point + 1 - (s = take_digits(point + 1, digits));
        if (*s == 'e' || *s == 'E') {
            bool negative = s[1] == '-';
            s = take_digits(s + 1 + (negative || s[1] == '+'), more);
            if (strtol(more, NULL, 10) >= LONGEST) refuse("an exponent is too large: %s", more);
            power += negative ? -strtol(more, NULL, 10) : strtol(more, NULL, 10);
        }
        mpz_ui_pow_ui(z, 10, (unsigned long)labs(power));
    }
    if (*s || !mpz_sgn(z)) refuse("no number ends in \"%.40s\"", s);
    mpz_set_str(mpq_numref(q), digits, 10);
    mpz_set_ui(mpq_denref(q), 1);
    if (power > 0) mpz_mul(mpq_numref(q), mpq_numref(q), z);
    else mpz_set(mpq_denref(q), z);
}

static void rational(mpq_t q) {
    number(q);
    mpq_canonicalize(q);
}

static void not_negative(mpq_t q) {
    rational(q);
    if (mpq_sgn(q) < 0) refuse("a number is negative that is not to be");
}

/* Read what a form shows: itself, ' being a quotation mark; and a text for %s, a number for %q or
 * %p if it is to be >= 0, a whole number below another for %i, true or false for %b. */
static void scan(const char *form, ...) {
    va_list to;
    va_start(to, form);
    for (bool quoted = false; *form; form++) {
        if (*form == '%' && form[1] == 's') *va_arg(to, char **) = string();
        else if (*form == '%' && form[1] == 'q') rational(va_arg(to, mpq_ptr));
        else if (*form == '%' && form[1] == 'p') not_negative(va_arg(to, mpq_ptr));
        else if (*form == '%' && form[1] == 'b') *va_arg(to, bool *) = truth();
        else if (*form == '%') {
            long below = va_arg(to, long);
            *va_arg(to, long *) = whole(below);
        } else {
            while (!quoted && *at == ' ') at++;
            if (*at != (*form == '\'' ? '"' : *form))
                refuse("\"%.40s\" where %.20s should be", at, form);
            quoted ^= *at++ == '"';
        }
        if (*form == '%') form++;
    }
    va_end(to);
}

static void end_line(void) {
    scan("}");
    if (take(" ") || *at) refuse("it goes on with \"%.40s\"", at);
}

/* Whether a list goes on: with its first entry, or past a comma. */
static bool goes_on(size_t *entries) {
    if (take("]")) return false;
    if ((*entries)++) scan(",");
    return true;
}

static void need_line(void) {
    if (!next_line()) refuse("%zu lines where there should be %ld", n_lines, 2 * n + 2);
}

/* In units, rounded down. */
static void floored(mpz_t rounded, const mpq_t q) {
    mpz_mul(rounded, mpq_numref(q), units);
    mpz_fdiv_q(rounded, rounded, mpq_denref(q));
}

/* ---- The question ---- */

static size_t set_of(const char *name) {
    for (size_t s = 0; s < n_sets; s++)
        if (!strcmp(name, sets[s])) return s;
    refuse("there is no set \"%s\"", name);
}

static struct quantity *new_quantity(char *name) {
    quantities = grown(quantities, n_rows, sizeof *quantities);
    struct quantity *q = quantities + n_rows++;
    *q = (struct quantity){.name = name, .costs = rationals((size_t)n_costs)};
    mpq_inits(q->constant, q->stop, q->bound, NULL);
    return q;
}

static void add_term(struct quantity *q, const mpq_t weight, enum kind kind, bool *states) {
    q->terms = grown(q->terms, q->size, sizeof *q->terms);
    struct term *term = q->terms + q->size++;
    term->kind = kind;
    term->states = states;
    mpq_init(term->weight);
    mpq_set(term->weight, weight);
}

static void read_quantity(struct quantity *q) {
    scan("{'constant':%q,'terms':[", q->constant);
    for (size_t i = 0; goes_on(&i); scan("]")) {
        char *kind, *set;
        long cost;
        scan("[%q,%s,", a, &kind);
        if (!strcmp(kind, "cost")) {
            scan("%i", n_costs, &cost);
            mpq_add(q->costs[cost], q->costs[cost], a);
        } else if (!strcmp(kind, "visits") || !strcmp(kind, "end")) {
            scan("%s", &set);
            add_term(q, a, !strcmp(kind, "end") ? END : VISITS, in_set[set_of(set)]);
        } else refuse("no quantity is called \"%s\"", kind);
    }
    scan("}");
}

/* Turn a quantity's sign, if that is asked; and ends of negative weight into all other ends. */
static void settle(struct quantity *q, bool turn) {
    if (turn) mpq_neg(q->constant, q->constant);
    for (long cost = 0; cost < n_costs; cost++) {
        if (turn) mpq_neg(q->costs[cost], q->costs[cost]);
        if (mpq_sgn(q->costs[cost]) < 0) refuse("costs count negatively in %s", q->name);
    }
    for (struct term *t = q->terms; t < q->terms + q->size; t++) {
        if (turn) mpq_neg(t->weight, t->weight);
        if (t->kind != END || mpq_sgn(t->weight) >= 0) continue;
        t->kind = OTHER_END;
        mpq_add(q->constant, q->constant, t->weight);
        mpq_neg(t->weight, t->weight);
        mpq_add(q->stop, q->stop, t->weight);
    }
}

static void read_failure(void) {
    if (take("null")) return;
    struct quantity *q = new_quantity("failure");
    budgeted = true;
    mpq_set(q->stop, one);
    add_term(q, one, OTHER_END, goal);
    least = take("\"least\"");
    sharing = !least && take("{");
    if (sharing) scan("'share':%p}", share);
    else if (!least) rational(q->bound);
    if (mpq_cmp(share, one) > 0) refuse("a share is no probability");
}

static void read_row(void) {
    char *name, *side;
    scan("{'name':%s,'quantity':", &name);
    struct quantity *q = new_quantity(kept(name));
    for (struct quantity *other = quantities + 1; other < q; other++)
        if (!strcmp(other->name, q->name)) refuse("two rows are called %s", q->name);
    read_quantity(q);
    scan(",%s:%q}", &side, q->bound);
    bool turns = !strcmp(side, "at_least");
    if (!turns && strcmp(side, "at_most")) refuse("a row has a name and one bound");
    settle(q, turns);
    if (turns) mpq_neg(q->bound, q->bound);
    mpq_sub(q->bound, q->bound, q->constant);
    mpq_set_ui(q->constant, 0, 1);
}

static void new_set(char *name) {
    sets = grown(sets, n_sets, sizeof *sets);
    in_set = grown(in_set, n_sets, sizeof *in_set);
    sets[n_sets] = name;
    in_set[n_sets++] = zeros((size_t)n + 1, 1);
}

static void read_question(void) {
    char *text;
    scan("{'format':'ssp-lp certificate 1','asked':%s,", &text);
    asked = kept(text);
    scan("'states':%i,'costs':%i,'sets':[", (long)INT32_MAX, &n, 1000L, &n_costs);
    paid = rationals((size_t)n_costs);
    least_paid = rationals((size_t)n_costs);
    first_pair = zeros((size_t)n + 2, sizeof *first_pair);
    coming = zeros((size_t)n + 1, sizeof *coming);
    new_set("goal");
    goal = in_set[0];
    for (size_t i = 0; goes_on(&i); new_set(kept(text))) scan("%s", &text);
    scan(",'start':[");
    while (goes_on(&n_start)) {
        start_part = grown(start_part, n_start - 1, sizeof *start_part);
        start_state = grown(start_state, n_start - 1, sizeof *start_state);
        mpq_init(start_part[n_start - 1]);
        scan("[%p,%i]", start_part[n_start - 1], n, &start_state[n_start - 1]);
        mpq_add(sum, sum, start_part[n_start - 1]);
    }
    if (!mpq_sgn(sum)) refuse("the start is no distribution");
    for (size_t i = 0; i < n_start; i++) mpq_div(start_part[i], start_part[i], sum);
    scan(",'give_up':%s,'charge_failing_step':%b,", &text, &charging);
    scan("'greatest':%b,'objective':", &greatest);
    anywhere = !strcmp(text, "anywhere");
    attention = !strcmp(text, "attention");
    if (!anywhere && !attention && strcmp(text, "dead_ends"))
        refuse("give_up is \"%s\"", text);
    read_quantity(new_quantity("objective"));
    settle(quantities, greatest);
    scan(",'failure':");
    read_failure();
    scan(",'discount':");
    mpq_set(discount, one);
    if (!take("null")) rational(discount);
    if (mpq_sgn(discount) <= 0 || mpq_cmp(discount, one) > 0) refuse("a discount lies in (0, 1)");
    if ((sharing || least) && !mpq_equal(discount, one))
        refuse("a share, or least failure, is of the real probability: without discount");
    scan(",'rows':[");
    for (size_t i = 0; goes_on(&i);) read_row();
    end_line();
}

/* ---- The model ---- */

/* What is paid of a cost, times the sum of the probabilities. */
static void read_cost(mpq_t mean) {
    size_t i = 0;
    bool each = take("[");
    mpq_set_ui(mean, 0, 1);
    if (!each) not_negative(a), add_product(mean, a, sum);
    while (each && goes_on(&i)) {
        not_negative(a);
        if (i <= told) add_product(mean, a, part[i - 1]);
    }
    if (each && i != told) refuse("as many costs as outcomes, fails");
}

static void read_pair(void) {
    static size_t room = 0;
    size_t cost = 0;
    scan("[%s,[", &action);
    mpq_set_ui(sum, 0, 1);
    for (told = 0; goes_on(&told);) {
        for (; room <= told; room++) {  /* one more is for what a discount takes */
            part = grown(part, room, sizeof *part);
            next = grown(next, room, sizeof *next);
            mpq_init(part[room]);
        }
        scan("[%p,%i]", part[told - 1], n, &next[told - 1]);
        mpq_add(sum, sum, part[told - 1]);
    }
    if (!mpq_sgn(sum)) refuse("probabilities >= 0, not all of them 0");
    scan(",[");
    while (goes_on(&cost)) read_cost(paid[cost > (size_t)n_costs ? (size_t)n_costs : cost - 1]);
    if (cost != (size_t)n_costs) refuse("as many costs as are said to be there, fails");
    scan("]");
    if (mpq_equal(discount, one)) return;
    for (size_t i = 0; i < told; i++) mpq_mul(part[i], part[i], discount);
    mpq_sub(a, one, discount);
    mpq_mul(part[told], a, sum);
    next[told++] = n;
}

/* Read the question and the model, and do this at the actions of each state. */
static void read_model(void (*at_actions)(void)) {
    char digits[65];
    if (gzrewind(file)) fail("the file cannot be read twice, as a pipe cannot");
    n_lines = 0;
    hashed = 0;
    take_roots(hash, 8, 2);
    need_line();
    if (!asked) read_question();
    for (state = 0; state < n; state++) {
        char *set;
        need_line();
        scan("{'name':%s,'sets':[", &state_name);
        for (size_t i = 0; goes_on(&i); in_set[set_of(set)][state] = true) scan("%s", &set);
        scan(",'actions':[");
        at_actions();
    }
    end_hash(digits);
    if (*digest && strcmp(digest, digits)) fail("the file has changed while it was read");
    strcpy(digest, digits);
}

static void keep_graph(void) {
    for (size_t i = 0; goes_on(&i); n_pairs++) {
        read_pair();
        pairs = grown(pairs, n_pairs, sizeof *pairs);
        pairs[n_pairs] = (struct pair){.home = (uint32_t)state, .costless = true, .keeps = true};
        for (size_t j = 0; j < n_rows; j++)
            for (long cost = 0; cost < n_costs; cost++)
                if (mpq_sgn(paid[cost]) && mpq_sgn(quantities[j].costs[cost]))
                    pairs[n_pairs].costless = false;
        for (size_t o = 0; o < told; o++) {
            if (!mpq_sgn(part[o])) continue;
            outcomes = grown(outcomes, n_outcomes, sizeof *outcomes);
            struct outcome outcome = {(uint32_t)n_pairs, (uint32_t)next[o], coming[next[o]]};
            outcomes[n_outcomes] = outcome;
            coming[next[o]] = (uint32_t)++n_outcomes;
        }
        if (n_outcomes > UINT32_MAX / 2) fail("there are too many outcomes");
    }
    first_pair[state + 1] = first_pair[n + 1] = n_pairs;
    end_line();
}

/* ---- What follows from the graph ---- */

/* Shrink a set of states until each has no pair, or one that stays in it; or, if so asked, until
 * all pairs stay. Pairs are those that are allowed, of which those that stay are left. */
static void shrink(bool *inside, bool *allowed, bool all) {
    uint32_t *ahead = zeros((size_t)n + 1, sizeof *ahead);
    uint32_t *ways = zeros((size_t)n + 1, sizeof *ways);  /* to stay, or 1 */
    size_t size = 0;
    for (size_t pair = 0; pair < n_pairs; pair++) {
        uint32_t x = pairs[pair].home;
        allowed[pair] = allowed[pair] && inside[x];
        if (allowed[pair] && !(all && ways[x])) ways[x]++;
    }
    for (long x = 0; x <= n; x++)
        if (!inside[x] || (!all && !ways[x] && first_pair[x] < first_pair[x + 1]))
            ahead[size++] = (uint32_t)x;
    while (size) {
        uint32_t y = ahead[--size];
        inside[y] = false;
        for (uint32_t i = coming[y]; i; i = outcomes[i - 1].other) {
            uint32_t pair = outcomes[i - 1].pair, x = pairs[pair].home;
            if (!allowed[pair]) continue;
            allowed[pair] = false;
            if (ways[x] && !--ways[x]) ahead[size++] = x;
        }
    }
    free(ahead);
    free(ways);
}

/* What a quantity counts on arriving in a state, but for charges; of its visits, or of all. */
static void arrivals(mpq_t count, const struct quantity *q, long x, bool all) {
    mpq_set_ui(count, 0, 1);
    for (const struct term *t = q->terms; t < q->terms + q->size; t++)
        if (t->kind == VISITS || all)
            if (t->kind == OTHER_END ? !live[x] && !t->states[x] : t->states[x])
                mpq_add(count, count, t->weight);
}

/* Refuse quantities that have no meaning; pairs after which they count a visit are not costless. */
static void check_quantities(void) {
    bool *seen = zeros((size_t)n + 1, 1);
    for (struct quantity *q = quantities; q < quantities + n_rows; q++)
        for (long x = 0; x < n; x++) {
            for (struct term *t = q->terms; t < q->terms + q->size; t++)
                if (t->kind != VISITS && t->states[x] && live[x])
                    refuse("%s counts ends in state %ld, where nothing ends", q->name, x);
            arrivals(a, q, x, false);
            if (mpq_sgn(a) < 0) refuse("visits count negatively in %s", q->name);
            seen[x] = seen[x] || (live[x] && mpq_sgn(a));
        }
    for (struct outcome *o = outcomes; o < outcomes + n_outcomes; o++)
        if (seen[o->state]) pairs[o->pair].costless = false;
    free(seen);
}

/* Where the goal can surely be reached, by pairs that keep it sure. */
static void find_sure(bool *allowed) {
    bool *lost = zeros((size_t)n + 1, 1);
    for (bool shrinks = true; shrinks;) {
        shrinks = false;
        for (size_t pair = 0; pair < n_pairs; pair++) pairs[pair].keeps = sure[pairs[pair].home];
        for (struct outcome *o = outcomes; o < outcomes + n_outcomes; o++)
            if (!sure[o->state] && !goal[o->state]) pairs[o->pair].keeps = false;
        for (size_t pair = 0; pair < n_pairs; pair++) allowed[pair] = pairs[pair].keeps;
        for (long x = 0; x <= n; x++) lost[x] = !goal[x];
        shrink(lost, allowed, true);
        for (long x = 0; x <= n; x++)
            if (sure[x] && lost[x]) shrinks = true, sure[x] = false;
    }
    free(lost);
}

static void follow_graph(void) {
    bool *allowed = zeros(n_pairs, 1), surely = true;
    bool **some[] = {&dead, &live, &giving_up, &wandering, &roaming, &sure};
    for (size_t i = 0; i < sizeof some / sizeof *some; i++) *some[i] = zeros((size_t)n + 1, 1);
    for (long x = 0; x <= n; x++) {
        if (goal[x] && first_pair[x] < first_pair[x + 1])
            refuse("a goal has actions: state %ld", x);
        dead[x] = giving_up[x] = !goal[x];
    }
    memset(allowed, true, n_pairs);
    shrink(dead, allowed, true);
    for (long x = 0; x <= n; x++)
        live[x] = wandering[x] = roaming[x] = sure[x] = !dead[x] && !goal[x];
    check_quantities();
    memset(allowed, true, n_pairs);
    shrink(giving_up, allowed, false);  /* where the goal can surely be avoided */
    for (long x = 0; x <= n; x++)
        giving_up[x] = live[x] && (anywhere || (attention && giving_up[x]));
    for (size_t pair = 0; pair < n_pairs; pair++) {
        pairs[pair].stays = allowed[pair];
        allowed[pair] = pairs[pair].costless;
    }
    shrink(wandering, allowed, false);  /* where wandering takes nothing of any quantity */
    memset(allowed, true, n_pairs);
    shrink(roaming, allowed, false);    /* where it is possible, whatever it takes */
    find_sure(allowed);
    for (size_t i = 0; i < n_start; i++)
        if (mpq_sgn(start_part[i]) && !sure[start_state[i]])
            surely = surely && goal[start_state[i]];
    if (least && !surely) sharing = true, mpq_set(share, one);
    may_fail = !budgeted || sharing || mpq_sgn(quantities[1].bound);
    if (!may_fail && !surely) refuse("failure 0: the goal can be reached surely, fails");
    if (may_fail) memcpy(sure, live, (size_t)n + 1);
    free(allowed);
}

/* ---- The proof ---- */

static size_t read_numbers(mpq_t **numbers) {
    size_t count = 0;
    while (goes_on(&count)) {
        *numbers = grown(*numbers, count - 1, sizeof **numbers);
        mpq_init((*numbers)[count - 1]);
        not_negative((*numbers)[count - 1]);
    }
    return count;
}

static void read_head(void) {
    char *signature;
    need_line();
    scan("{'sha256':%s,'claim':[%q,%q],'prices':[", &signature, claimed[0], claimed[1]);
    if (strcmp(signature, digest)) refuse("the SHA-256 is not that of the question and the model");
    if (read_numbers(&prices) != n_rows - 1) refuse("a price a row, fails");
    scan(",'weights':[");
    n_members = read_numbers(&weights);
    end_line();
    mpq_set_ui(sum, 0, 1);
    for (size_t m = 0; m < n_members; m++) mpq_add(sum, sum, weights[m]);
    if (!mpq_equal(sum, one)) refuse("weights are >= 0 and sum to 1, fails");
}

/* The column of a member's quantity, which comes after its steps and its objective. */
static struct column *column_of(size_t member, size_t quantity) {
    return columns + 2 + member * (n_rows + 1) + quantity;
}

static void make_column(struct column *y, const char *name, size_t member, long quantity) {
    if (y < columns + 2) strcpy(y->name, name);
    else snprintf(y->name, sizeof y->name, "member %zu: -u of %s", member, name);
    y->share = rationals(n_rows);
    y->costs = rationals((size_t)n_costs);
    mpq_init(y->stop);
    y->after = resized(NULL, (size_t)n, sizeof *y->after);
    for (long x = 0; x <= n; x++) mpz_init(y->after[x]);
    if (quantity >= 0) mpq_set_si(y->share[quantity], y < columns + 2 ? 1 : -1, 1);
    for (size_t j = 1; j < n_rows && y == columns; j++) mpq_set(y->share[j], prices[j - 1]);
    for (size_t j = 0; j < n_rows; j++) {
        for (long cost = 0; cost < n_costs; cost++)
            add_product(y->costs[cost], y->share[j], quantities[j].costs[cost]);
        add_product(y->stop, y->share[j], quantities[j].stop);
    }
}

static void make_columns(void) {
    n_columns = 2 + n_members * (n_rows + 1);
    columns = zeros(n_columns, sizeof *columns);
    make_column(columns, "v", 0, 0);
    make_column(columns + 1, "w", 0, sharing ? 1 : NONE);
    for (size_t m = 0; m < n_members; m++) {
        make_column(column_of(m, 0), "steps", m, NONE);
        column_of(m, 0)->steps = true;
        for (size_t j = 0; j < n_rows; j++)
            make_column(column_of(m, j + 1), quantities[j].name, m, (long)j);
        int32_t *decision = zeros((size_t)n, sizeof *decision);
        for (size_t j = 0; j <= n_rows; j++) column_of(m, j)->decision = decision;
    }
}

static void read_value(struct column *y, int sign) {
    number(a);
    if (sign < 0) mpz_neg(mpq_numref(a), mpq_numref(a));
    floored(z, a);
    mpz_set(y->after[state], z);
}

static void read_member(size_t member) {
    int32_t *decision = column_of(member, 0)->decision + state;
    *decision = NONE;
    if (take("null")) return;
    if (!live[state]) refuse("member %zu decides where nothing has ended, fails", member);
    scan("[");
    if (take("\"stop\"")) *decision = STOP;
    else *decision = (int32_t)whole((long)(first_pair[state + 1] - first_pair[state]));
    if (*decision == STOP && !wandering[state] && !giving_up[state])
        refuse("member %zu stops where it may, fails", member);
    for (size_t j = 0; j <= n_rows; j++) {
        scan(",");
        read_value(column_of(member, j), -1);
    }
    scan("]");
}

static void read_proof(void) {
    read_head();
    make_columns();
    for (state = 0; state < n; state++) {
        size_t members = 0;
        need_line();
        scan("{'v':");
        read_value(columns, 1);
        scan(",'members':[");
        while (goes_on(&members) && members <= n_members) read_member(members - 1);
        if (members != n_members) refuse("as many members as weights, fails");
        if (sharing) scan(",'w':"), read_value(columns + 1, 1);
        if (!sure[state]) mpz_set_ui(columns[0].after[state], 0);  /* v says nothing of it */
        if (!live[state]) mpz_set_ui(columns[1].after[state], 0);
        end_line();
    }
    if (next_line()) refuse("%zu lines where there should be %ld", n_lines, 2 * n + 2);
}

/* Least means of the costs, of this pair and of those before. */
static void take_least(bool first) {
    for (long cost = 0; cost < n_costs; cost++) {
        mpq_div(a, paid[cost], sum);
        if (first || mpq_cmp(a, least_paid[cost]) < 0) mpq_set(least_paid[cost], a);
    }
}

/* What a column counts on arriving in the state, in units. */
static void arrive(mpz_t count, const struct column *y) {
    mpq_set_ui(b, 0, 1);
    for (size_t j = 0; j < n_rows; j++) {
        if (!mpq_sgn(y->share[j])) continue;
        arrivals(a, quantities + j, state, true);
        add_product(b, y->share[j], a);
    }
    for (long cost = 0; cost < n_costs && dead[state]; cost++)
        add_product(b, y->costs[cost], least_paid[cost]);
    floored(count, b);
}

static void charge_arrivals(void) {
    for (long cost = 0; cost < n_costs; cost++) mpq_set_ui(least_paid[cost], 0, 1);
    for (size_t i = 0; state < n && dead[state] && charging && goes_on(&i);) {
        read_pair();
        take_least(i == 1);
    }
    for (struct column *y = columns; y < columns + n_columns; y++) {
        arrive(z, y);
        mpz_add(y->after[state], y->after[state], z);
    }
}

/* Whether an inequality of a column is asked of an action, of this number; or of a stop. */
static bool asked_of(const struct column *y, int32_t number, size_t pair) {
    if (y->decision) return y->decision[state] == number;
    if (y == columns + 1) return sharing && (number != STOP || roaming[state] || giving_up[state]);
    if (number == STOP) return may_fail && (wandering[state] || giving_up[state]);
    return may_fail || pairs[pair].keeps;
}

/* A column's inequality at the pair that was read; a stop has no outcomes, and sum 1. */
static void check(struct column *y, bool stopping) {
    mpq_set_ui(b, 0, 1);
    if (stopping) mpq_set(b, y->stop);
    if (y->steps) mpq_sub(b, b, sum);
    for (long cost = 0; cost < n_costs; cost++) add_product(b, y->costs[cost], paid[cost]);
    mpq_set_z(a, units);
    mpq_mul(right, a, b);
    for (size_t i = 0; i < told; i++) {
        if (y->decision && live[next[i]] && y->decision[next[i]] == NONE && mpq_sgn(part[i]))
            refuse("%s decides after %s %s, fails", y->name, state_name, action);
        mpq_set_z(a, y->after[next[i]]);
        add_product(right, part[i], a);
    }
    arrive(z, y);
    mpz_sub(z, y->after[state], z);
    mpq_set_z(a, z);
    mpq_mul(left, a, sum);
    if (mpq_cmp(left, right) <= 0) return;
    mpq_set_z(b, units);  /* as decimals, which are only to be read */
    mpq_mul(b, b, sum);
    mpq_div(left, left, b);
    mpq_div(right, right, b);
    refuse("%s <= own + sum p %s at %s %s fails: %.17g > %.17g", y->name, y->name, state_name,
           action, mpq_get_d(left), mpq_get_d(right));
}

static void check_state(void) {
    if (!live[state]) return;
    static char stopping[] = "stopping";
    size_t i = 0, charged = 0;
    for (long cost = 0; cost < n_costs; cost++) mpq_set_ui(least_paid[cost], 0, 1);
    for (size_t pair = first_pair[state]; goes_on(&i); pair++) {
        read_pair();
        if (charging && (anywhere || pairs[pair].stays)) take_least(!charged++);
        for (struct column *y = columns; y < columns + n_columns; y++)
            if (asked_of(y, (int32_t)i - 1, pair)) check(y, false);
    }
    told = 0;
    mpq_set(sum, one);
    action = stopping;
    for (long cost = 0; cost < n_costs; cost++)
        if (wandering[state]) mpq_set_ui(paid[cost], 0, 1);
        else mpq_set(paid[cost], least_paid[cost]);
    for (struct column *y = columns; y < columns + n_columns; y++)
        if (asked_of(y, STOP, 0)) check(y, true);
}

/* ---- The verdict ---- */

/* What a column proves at the start, but for the constant of its quantity. */
static void prove(mpq_t bound, const struct column *y) {
    mpq_set_ui(bound, 0, 1);
    for (size_t i = 0; i < n_start; i++) {
        long x = start_state[i];
        if (y->decision && live[x] && y->decision[x] == NONE && mpq_sgn(start_part[i]))
            refuse("%s decides at the start, fails", y->name);
        mpq_set_z(a, y->after[x]);
        add_product(bound, start_part[i], a);
    }
    mpq_set_z(a, units);
    mpq_div(bound, bound, a);
}

/* 1 - share * (1 - failure), of a bound of failure */
static void budget_of(mpq_t budget, const mpq_t failure) {
    mpq_sub(a, one, failure);
    mpq_mul(a, a, share);
    mpq_sub(budget, one, a);
}

/* A bound in 25 decimals, rounded so that it holds, and as a fraction. */
static void print_bound(const char *name, const mpq_t bound, bool up) {
    mpz_ui_pow_ui(z, 10, 25);
    mpz_mul(mpq_numref(a), mpq_numref(bound), z);
    (up ? mpz_cdiv_q : mpz_fdiv_q)(mpq_numref(a), mpq_numref(a), mpq_denref(bound));
    const char *sign = mpz_sgn(mpq_numref(a)) < 0 ? "-" : "";
    mpz_abs(mpq_numref(a), mpq_numref(a));
    mpz_fdiv_qr(mpq_numref(a), z, mpq_numref(a), z);
    gmp_printf("  %-9s %s%Zd.%025Zd = %Qd\n", name, sign, mpq_numref(a), z, bound);
}

static void conclude(void) {
    mpq_t *taken = rationals(n_rows), lower, loose, most, failed;
    mpq_inits(lower, loose, most, failed, NULL);
    for (size_t m = 0; m < n_members; m++)
        for (size_t j = 0; j < n_rows; j++) {
            prove(b, column_of(m, j + 1));
            mpq_sub(b, quantities[j].constant, b);
            add_product(taken[j], weights[m], b);
            if (j == 1 && (m == 0 || mpq_cmp(b, failed) < 0)) mpq_set(failed, b);
        }
    if (budgeted) mpq_set(loose, quantities[1].bound);
    if (sharing) {  /* the least failure lies between what w proves and what a member does */
        prove(b, columns + 1);
        budget_of(quantities[1].bound, b);
        budget_of(loose, failed);
    }
    prove(lower, columns);
    mpq_add(lower, lower, quantities[0].constant);
    for (size_t j = 1; j < n_rows; j++) {
        mpq_neg(a, j == 1 && budgeted ? loose : quantities[j].bound);
        add_product(lower, prices[j - 1], a);
        mpq_sub(taken[j], taken[j], quantities[j].bound);
        mpq_set_ui(most, 1, 1000000000);
        mpq_abs(a, quantities[j].bound);
        mpq_mul(most, most, a);
        if (mpq_cmp(taken[j], most) > 0)
            refuse("lottery <= bound of row %s fails by %.17g", quantities[j].name,
                   mpq_get_d(taken[j]));
    }
    mpq_sub(most, taken[0], lower);
    if (greatest) {
        mpq_neg(lower, lower);
        mpq_neg(taken[0], taken[0]);
        mpq_swap(lower, taken[0]);
    }
    if (mpq_cmp(lower, claimed[0]) < 0 || mpq_cmp(taken[0], claimed[1]) > 0)
        refuse("claimed is %.17g to %.17g, proved from %.17g to %.17g", mpq_get_d(claimed[0]),
               mpq_get_d(claimed[1]), mpq_get_d(lower), mpq_get_d(taken[0]));
    printf("accepted: \"%s\"\n  SHA-256   %s\n", asked, digest);
    print_bound("at least", lower, false);
    print_bound("at most", taken[0], true);
    printf("  width     %.1e\n", mpq_get_d(most));
    for (size_t j = 1; j < n_rows; j++)
        if (mpq_sgn(taken[j]) > 0)
            gmp_printf("  the lottery exceeds row %s by %Qd\n", quantities[j].name, taken[j]);
}

int main(int count, char **arguments) {
    if (count != 2) fail("usage: check FILE");
    if (!(file = gzopen(arguments[1], "rb"))) fail("the file cannot be opened");
    gzbuffer(file, 1 << 18);
    if (gzdirect(file)) refuse("the file is not gzip");
    mpz_inits(units, z, NULL);
    mpq_inits(claimed[0], claimed[1], one, a, b, c, left, right, sum, discount, share, NULL);
    mpz_ui_pow_ui(units, 10, DIGITS);
    mpq_set_ui(one, 1, 1);
    take_roots(k, 64, 3);
    read_model(keep_graph);
    follow_graph();
    read_proof();
    read_model(charge_arrivals);
    charge_arrivals();  /* of what a discount takes */
    read_model(check_state);
    at = NULL;
    conclude();
    return 0;
}
