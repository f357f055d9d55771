/* Trials of tabular Q-learning on a gridworld in plain C, on one core: the reference of speed for Table 1.

       cc -std=c99 -O3 -ffp-contract=off -o table1 table1.c -lm
       ./table1 DESCRIPTION [RESULTS]

   It does what the loop does, bit for bit: Page-Hinkley on the return, MORPHIN's response, one of three exploration
   schedules, Q-learning with the step size alpha*, the uniforms of NumPy's PCG64. What a run has no use for is left
   out: records, hashes, action sets that change, floors that slip.

   DESCRIPTION is text, numbers apart by white space; real ones may be hexadecimal, which loses no bit:

       actions states max_steps start episodes trials
       step_reward goal_reward
       discount bootstrap_terminal alpha alpha_max k
       schedule p1 p2 p3 p4     0: epsilon - - -; 1: eps_min decay - -; 2: eps_min decay on_success on_failure
       detects delta threshold responds
       goals, then their states; switches, then their episodes
       moves, actions x states: the state to which an action leads
       per trial four words of 64 bits, hexadecimal: PCG64's state, high and low, and its increment

   RESULTS gets the rows of all episodes (`Row`), then the Q-tables (trials x states x actions, doubles), as they stand
   in memory. Standard output gets the total of steps, the number of alarms, the seconds that the trials took and the
   nanoseconds of a step. */

#define _POSIX_C_SOURCE 199309L
#include <inttypes.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

__extension__ typedef unsigned __int128 Word128;

/* What is always inlined is compiled once for each constant that it is called with. */
#define INLINE static inline __attribute__((always_inline))

enum { CONSTANT, EXPONENTIAL, SUCCESS };

typedef struct {
    int actions, states, max_steps, start, episodes, trials;
    double step_reward, goal_reward;
    double discount;
    int bootstrap_terminal;
    double alpha, alpha_max, k;
    int schedule;
    double parameter[4];
    int detects, responds;
    double delta, threshold;
    int goals, switches;
    int *goal, *switch_at;
    int *moves;           /* [state][action] */
    int *worth_exploring; /* [state]: how many actions of `choices` */
    uint8_t *choices;     /* [state][...]: the actions that change the state; all, where none does */
    Word128 block_power, block_sum; /* the generator goes on by an episode's block: state * power + increment * sum */
} Task;

typedef struct {
    int32_t steps, alarm;
    double total, epsilon, td_error, q_change;
} Row;

typedef struct {
    double *q;         /* [state][action] */
    uint32_t *touched; /* likewise: the last episode that wrote the value */
    int *journal;      /* places of the values that this episode has written */
    double *saved;     /* and what they were */
} Table;

typedef struct {
    Word128 state, increment;
} Stream;

/* PCG64: O'Neill's PCG XSL RR 128/64 as in NumPy. */

#define MULTIPLIER (((Word128)0x2360ed051fc65da4u << 64) | 0x4385df649fccf645u)

INLINE double uniform(Word128 state) {
    uint64_t folded = (uint64_t)(state >> 64) ^ (uint64_t)state;
    unsigned turn = (unsigned)(state >> 122);
    return (double)((folded >> turn | folded << (-turn & 63)) >> 11) * 0x1p-53;
}

static void fix_block(Task *task) {
    task->block_power = 1;
    task->block_sum = 0;
    for (int draw = 0; draw < 2 * task->max_steps; draw++) {
        task->block_sum = task->block_sum * MULTIPLIER + 1;
        task->block_power *= MULTIPLIER;
    }
}

/* The action of the largest value; of equal ones, the first. Without a branch, as none could be foretold. */
INLINE int greedy(const double *value, const int actions) {
    if (actions == 4) { /* two comparisons side by side, then one */
        const double a = value[0], b = value[1], c = value[2], d = value[3];
        const int low = b > a, high = d > c;
        const int upper = (high ? d : c) > (low ? b : a);
        return upper << 1 | (high & upper) | (low & ~upper);
    }
    int best = 0;
    double largest = value[0];
    for (int action = 1; action < actions; action++) {
        best = value[action] > largest ? action : best;
        largest = value[action] > largest ? value[action] : largest;
    }
    return best;
}

/* `fixed`: alpha_max is alpha, and so is the learning rate, whatever the TD error. */
INLINE Row episode(const Task *task, Table table, uint32_t number, int goal, double epsilon, Stream stream,
                   const int actions, const int fixed) {
    const Word128 second = stream.increment * (MULTIPLIER + 1);
    double total = 0.0, total_td = 0.0;
    int state = task->start, steps = 0, used = 0, ended = 0;
    int best = greedy(table.q + state * actions, actions);
    while (steps < task->max_steps && !ended) {
        int action = best;
        double draw = uniform(stream.state * MULTIPLIER + stream.increment);
        stream.state = stream.state * (MULTIPLIER * MULTIPLIER) + second; /* the second draw is taken, used or not */
        if (draw < epsilon)
            action = task->choices[state * actions + (int)(uniform(stream.state) * task->worth_exploring[state])];

        const int at = state * actions + action;
        const int next = task->moves[at];
        ended = next == goal;
        const double reward = ended ? task->goal_reward : task->step_reward;
        total += reward;
        steps++;

        const double *after = table.q + next * actions;
        best = greedy(after, actions);
        const double bootstrap = ended && !task->bootstrap_terminal ? 0.0 : after[best];
        const double old = table.q[at];
        const double td_error = reward + task->discount * bootstrap - old;
        double alpha = task->alpha;
        if (!fixed)
            alpha += (task->alpha_max - task->alpha) / (1.0 + exp(-(fabs(td_error) - task->k)));
        total_td += fabs(td_error);

        table.journal[used] = at;
        table.saved[used] = old;
        used += table.touched[at] != number;
        table.touched[at] = number;
        table.q[at] = old + alpha * td_error;
        if (next == state) /* the value that `best` has seen is not the one of now */
            best = greedy(after, actions);
        state = next;
    }
    double change = 0.0;
    for (int i = 0; i < used; i++) {
        double difference = fabs(table.q[table.journal[i]] - table.saved[i]);
        if (difference > change)
            change = difference;
    }
    return (Row){steps, 0, total, epsilon, total_td / steps, change};
}

INLINE double exploration(const Task *task, double counter) {
    if (task->schedule == CONSTANT)
        return task->parameter[0];
    return task->parameter[0] + (1.0 - task->parameter[0]) * exp(-task->parameter[1] * counter);
}

INLINE void trial(const Task *task, Table table, Stream stream, Row *rows, const int actions, const int fixed) {
    double n = 0.0, mean = 0.0, sum = 0.0, minimum = 0.0; /* Page-Hinkley */
    double counter = 0.0;                                 /* episodes since the last response, or the success rule's */
    int responded = 0, phase = 0;
    const Word128 block = stream.increment * task->block_sum;
    for (int number = 1; number <= task->episodes; number++, stream.state = stream.state * task->block_power + block) {
        while (phase < task->switches && task->switch_at[phase] <= number)
            phase++;
        Row row = episode(task, table, (uint32_t)number, task->goal[phase % task->goals], exploration(task, counter),
                          stream, actions, fixed);
        if (task->detects) {
            n += 1.0;
            mean += (row.total - mean) / n;
            sum += mean - row.total - task->delta;
            minimum = sum < minimum ? sum : minimum;
            row.alarm = sum - minimum > task->threshold;
            if (row.alarm)
                n = mean = sum = minimum = 0.0;
        }
        if (row.alarm && task->responds) {
            counter = 0.0;
            responded = 1;
        } else {
            counter += 1.0;
            if (task->schedule == SUCCESS && responded) {
                counter *= task->parameter[row.total > 0.0 ? 2 : 3];
                counter = counter < 1e6 ? counter : 1e6;
            }
        }
        rows[number - 1] = row;
    }
}

static void any_trial(const Task *task, Table table, Stream stream, Row *rows) {
    const int fixed = task->alpha == task->alpha_max;
    if (task->actions == 4 && fixed)
        trial(task, table, stream, rows, 4, 1);
    else if (task->actions == 4)
        trial(task, table, stream, rows, 4, 0);
    else
        trial(task, table, stream, rows, task->actions, fixed);
}

/* Reading, writing, measuring. */

static void fail(const char *what) {
    fprintf(stderr, "table1: %s\n", what);
    exit(2);
}

static void *room(size_t count, size_t size) {
    void *found = calloc(count ? count : 1, size);
    if (!found)
        fail("out of memory");
    return found;
}

static int integer(FILE *file) {
    int found;
    if (fscanf(file, "%d", &found) != 1)
        fail("an integer is missing from the description");
    return found;
}

static double real(FILE *file) {
    double found;
    if (fscanf(file, "%lf", &found) != 1)
        fail("a number is missing from the description");
    return found;
}

static Word128 word(FILE *file) {
    uint64_t high, low;
    if (fscanf(file, "%" SCNx64 "%" SCNx64, &high, &low) != 2)
        fail("a generator is missing from the description");
    return (Word128)high << 64 | low;
}

static int *integers(FILE *file, int count) {
    int *found = room((size_t)count, sizeof *found);
    for (int i = 0; i < count; i++)
        found[i] = integer(file);
    return found;
}

static Task read_task(FILE *file) {
    Task task;
    task.actions = integer(file), task.states = integer(file);
    task.max_steps = integer(file), task.start = integer(file);
    task.episodes = integer(file), task.trials = integer(file);
    if (task.actions < 1 || task.actions > 256 || task.states < 1 || task.max_steps < 1 || task.trials < 1)
        fail("there are 1 to 256 actions, and at least one state, step and trial");
    task.step_reward = real(file), task.goal_reward = real(file);
    task.discount = real(file), task.bootstrap_terminal = integer(file);
    task.alpha = real(file), task.alpha_max = real(file), task.k = real(file);
    task.schedule = integer(file);
    for (int i = 0; i < 4; i++)
        task.parameter[i] = real(file);
    task.detects = integer(file), task.delta = real(file), task.threshold = real(file);
    task.responds = integer(file);
    task.goals = integer(file), task.goal = integers(file, task.goals);
    task.switches = integer(file), task.switch_at = integers(file, task.switches);

    const size_t pairs = (size_t)task.states * task.actions;
    task.moves = room(pairs, sizeof *task.moves);
    task.choices = room(pairs, sizeof *task.choices);
    task.worth_exploring = room(task.states, sizeof *task.worth_exploring);
    for (int action = 0; action < task.actions; action++)
        for (int state = 0; state < task.states; state++) {
            int next = integer(file);
            if (next < 0 || next >= task.states)
                fail("a move leads outside the states");
            task.moves[state * task.actions + action] = next;
            if (next != state)
                task.choices[state * task.actions + task.worth_exploring[state]++] = (uint8_t)action;
        }
    for (int state = 0; state < task.states; state++)
        if (!task.worth_exploring[state])
            for (int action = 0; action < task.actions; action++)
                task.choices[state * task.actions + task.worth_exploring[state]++] = (uint8_t)action;
    fix_block(&task);
    return task;
}

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

int main(int count, char **argument) {
    if (count < 2 || count > 3)
        fail("give a description, and a file for the results where they are wanted");
    FILE *file = fopen(argument[1], "r");
    if (!file)
        fail("the description cannot be read");
    Task task = read_task(file);
    Stream *streams = room(task.trials, sizeof *streams);
    for (int i = 0; i < task.trials; i++) {
        streams[i].state = word(file);
        streams[i].increment = word(file);
    }
    fclose(file);

    const size_t pairs = (size_t)task.states * task.actions, all = (size_t)task.trials * task.episodes;
    Row *rows = room(all, sizeof *rows);
    double *kept = count == 3 ? room(task.trials * pairs, sizeof *kept) : NULL;
    Table table = {room(pairs, sizeof *table.q), room(pairs, sizeof *table.touched),
                   room(task.max_steps + 1, sizeof *table.journal), room(task.max_steps + 1, sizeof *table.saved)};

    const double begun = seconds();
    long long steps = 0, alarms = 0;
    for (int i = 0; i < task.trials; i++) {
        Row *mine = rows + (size_t)i * task.episodes;
        memset(table.q, 0, pairs * sizeof *table.q);
        memset(table.touched, 0, pairs * sizeof *table.touched);
        any_trial(&task, table, streams[i], mine);
        for (int k = 0; k < task.episodes; k++) {
            steps += mine[k].steps;
            alarms += mine[k].alarm;
            if (!isfinite(mine[k].td_error) || !isfinite(mine[k].q_change) || !isfinite(mine[k].total))
                fail("a number is not finite");
        }
        if (kept)
            memcpy(kept + i * pairs, table.q, pairs * sizeof *table.q);
    }
    const double took = seconds() - begun;

    printf("steps %lld\nalarms %lld\nseconds %.9f\nns_per_step %.4f\n", steps, alarms, took, 1e9 * took / steps);
    if (kept) {
        file = fopen(argument[2], "wb");
        if (!file || fwrite(rows, sizeof *rows, all, file) != all ||
            fwrite(kept, sizeof *kept, task.trials * pairs, file) != task.trials * pairs || fclose(file))
            fail("the results cannot be written");
    }
    return 0;
}
