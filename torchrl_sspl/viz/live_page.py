"""The page of the live view: one file without anything from elsewhere, light and dark, for a desk and for a phone."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">
<title>sspl watch: {{name}}</title><style>
:root{--ink:#1a1f27;--soft:#5b6470;--page:#f6f7f9;--card:#fff;--line:#dde1e7;--inside:#e3f4e6;--curve:#0072b2;--mark:#c2500a;
--PROOF_APPLIES:#13702f;--INSIDE:#7a5200;--OUTSIDE:#b3261e;--UNKNOWN_PICTURE:#7b2d8e}
@media(prefers-color-scheme:dark){:root{--ink:#e7eaee;--soft:#a3acb8;--page:#12151a;--card:#1b2027;--line:#323a45;--inside:#16351f;
--curve:#6cb8ec;--mark:#ff9a57;--PROOF_APPLIES:#7ddb95;--INSIDE:#f1c765;--OUTSIDE:#ff9d94;--UNKNOWN_PICTURE:#dba3ec}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1100px;margin:0 auto;padding:20px 16px 40px;display:grid;grid-template-columns:minmax(0,2fr) minmax(0,3fr);gap:16px}
header,.verdict,.facts,footer{grid-column:1/-1}
.curve{display:flex;flex-direction:column}.facts{padding:10px 16px}
header{display:flex;flex-wrap:wrap;gap:2px 16px;align-items:baseline}
h1{font-size:1.4rem;line-height:1.2;margin:0}header p,footer{margin:0;color:var(--soft);font-size:.9rem}
section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:14px 16px;min-width:0}
.verdict{border-left:8px solid var(--shown,var(--line));min-height:5.4rem}
.verdict h2{margin:0;font-size:1.5rem;line-height:1.25;color:var(--shown,var(--soft))}
.verdict p{margin:.2rem 0 0;overflow-wrap:anywhere;font-variant-numeric:tabular-nums}
h3{font-size:.9rem;font-weight:600;color:var(--soft);margin:0 0 .5rem}
img{display:block;width:100%;max-width:380px;aspect-ratio:1;margin:0 auto;image-rendering:pixelated;border-radius:6px;background:var(--line);
border:1px solid var(--line)}
dl{display:grid;grid-template-columns:repeat(auto-fit,minmax(130px,1fr));gap:.6rem 1rem;margin:0;font-variant-numeric:tabular-nums}
dt{color:var(--soft);font-size:.82rem}dd{margin:0;font-size:1.05rem;overflow-wrap:anywhere}
canvas{display:block;width:100%;height:200px;flex:1}
.key{display:flex;flex-wrap:wrap;gap:2px 18px;margin:.5rem 0 0;color:var(--soft);font-size:.85rem}
.key span::before{content:"";display:inline-block;width:.8em;height:.8em;margin-right:.4em;border-radius:2px;background:var(--c);vertical-align:-.05em}
@media(max-width:640px){main{grid-template-columns:minmax(0,1fr);gap:10px;padding:12px 8px 28px}.verdict h2{font-size:1.25rem}
img{max-width:250px}canvas{height:180px;flex:none}}
</style></head><body><main>
<header><h1>{{name}}</h1><p>{{about}}</p></header>
<section class="verdict" id="verdict"><h2 id="label" role="status">Waiting for the first step</h2><p id="why"></p></section>
<section><h3>What the agent sees</h3><img id="picture" alt="newest frame of the camera"></section>
<section class="curve"><h3>Barrier over time, below zero is inside the set</h3><canvas id="curve" role="img" aria-label="barrier over time"></canvas>
<p class="key"><span style="--c:var(--curve)">B</span><span style="--c:var(--mark)">filter intervened</span>
<span style="--c:var(--UNKNOWN_PICTURE)">alarm</span><span style="--c:var(--soft)">new episode</span></p></section>
<section class="facts"><dl>
<div><dt>Step, episode</dt><dd id="step">-</dd></div><div><dt>Barrier B</dt><dd id="barrier">-</dd></div>
<div><dt>Action wanted</dt><dd id="wanted">-</dd></div><div><dt>Action taken</dt><dd id="taken">-</dd></div>
<div><dt>Interventions</dt><dd id="interventions">-</dd></div><div><dt>Steps with an alarm</dt><dd id="alarms">-</dd></div>
<div><dt>Episodes into U</dt><dd id="entered">-</dd></div></dl></section>
<footer id="state">Connecting</footer>
</main><script>
const kept=300,events=[],byId=id=>document.getElementById(id),style=name=>getComputedStyle(document.documentElement).getPropertyValue(name).trim();
let ended=false,waiting=false;
const number=(x,d=3)=>x===null||x===undefined?"-":(x<0?"\\u2212":"")+Math.abs(x).toFixed(d);
const share=(n,of)=>n.toLocaleString("en")+(of?" ("+(100*n/of).toFixed(1)+" %)":"");
function show(){
  waiting=false;const e=events[events.length-1];if(!e)return;
  byId("label").textContent=e.label;byId("why").textContent=e.why;
  byId("verdict").style.setProperty("--shown","var(--"+e.verdict+")");
  byId("step").textContent=e.step.toLocaleString("en")+", "+e.episode;
  byId("barrier").textContent=number(e.barrier);
  byId("wanted").textContent=e.wanted.map(x=>number(x,2)).join(", ");byId("taken").textContent=e.taken.map(x=>number(x,2)).join(", ");
  byId("interventions").textContent=e.protected?share(e.interventions,e.step):"no filter";
  byId("alarms").textContent=share(e.alarms,e.step);byId("entered").textContent=e.unsafe===null?"not known":e.entered;
  draw();
}
function draw(){
  const canvas=byId("curve"),ratio=devicePixelRatio||1,w=canvas.clientWidth,h=canvas.clientHeight,c=canvas.getContext("2d");
  canvas.width=w*ratio;canvas.height=h*ratio;c.setTransform(ratio,0,0,ratio,0,0);
  const values=events.map(e=>e.barrier).filter(x=>x!==null);let low=Math.min(-.1,...values),high=Math.max(.1,...values);
  const room=.06*(high-low),left=46,right=w-6,top=6,bottom=h-22;low-=room;high+=room;
  const x=k=>left+(right-left)*k/(kept-1),y=v=>bottom-(bottom-top)*(v-low)/(high-low);
  c.fillStyle=style("--inside");c.fillRect(left,y(0),right-left,bottom-y(0));
  c.font="12px system-ui,sans-serif";c.fillStyle=style("--soft");c.textAlign="right";c.textBaseline="middle";
  const step=[.05,.1,.2,.5,1,2,5].find(s=>(high-low)/s<=6)||10;
  c.strokeStyle=style("--line");c.lineWidth=1;
  for(let v=Math.ceil(low/step)*step;v<=high;v+=step){const r=Math.round(v/step)*step;c.fillText(number(r,step<.1?2:1),left-6,y(r));
    c.beginPath();c.moveTo(left,y(r));c.lineTo(right,y(r));c.stroke()}
  c.strokeStyle=style("--ink");c.lineWidth=1.5;c.beginPath();c.moveTo(left,y(0));c.lineTo(right,y(0));c.stroke();
  const wide=Math.max(1.5,(right-left)/kept);
  events.forEach((e,k)=>{
    if(e.begins){c.strokeStyle=style("--soft");c.lineWidth=1;c.setLineDash([3,4]);c.beginPath();c.moveTo(x(k),top);c.lineTo(x(k),bottom);c.stroke();c.setLineDash([])}
    if(e.intervened){c.fillStyle=style("--mark");c.fillRect(x(k)-wide/2,bottom+3,wide,7)}
    if(e.alarm){c.fillStyle=style("--UNKNOWN_PICTURE");c.fillRect(x(k)-wide/2,bottom+12,wide,7)}
  });
  c.strokeStyle=style("--curve");c.lineWidth=2;c.lineJoin="round";c.beginPath();let on=false;
  events.forEach((e,k)=>{if(e.barrier===null){on=false;return}if(!on||e.begins){c.moveTo(x(k),y(e.barrier));on=true}else c.lineTo(x(k),y(e.barrier))});
  c.stroke();
}
const source=new EventSource("/events");
source.onopen=()=>{events.length=0;byId("state").textContent="Live"};
source.onmessage=m=>{const e=JSON.parse(m.data);if(e.picture)byId("picture").src=e.picture;events.push(e);if(events.length>kept)events.shift();
  if(!waiting){waiting=true;requestAnimationFrame(show)}};
source.addEventListener("end",()=>{ended=true;source.close();byId("state").textContent="Ended"});
source.onerror=()=>{if(!ended)byId("state").textContent="Not reachable; it may have ended. Trying again"};
addEventListener("resize",draw);matchMedia("(prefers-color-scheme:dark)").addEventListener("change",draw);
</script></body></html>
"""

__all__ = ["PAGE"]
