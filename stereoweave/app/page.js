// Gradio cannot cancel an event before the server has answered its request to join the queue.
const joins = new Set();
const load = window.fetch;

window.fetch = (...given) => {
    const answer = load(...given);
    if (String(given[0].url ?? given[0]).includes("/queue/join")) {
        joins.add(answer);
        const forget = () => joins.delete(answer);
        answer.then(forget, forget);
    }
    return answer;
};

// Resolves when all requests are answered, also those about to be sent.
window.joinsAnswered = async () => {
    do {
        await Promise.allSettled(joins);
        await new Promise((wake) => setTimeout(wake, 100));
    } while (joins.size);
};
